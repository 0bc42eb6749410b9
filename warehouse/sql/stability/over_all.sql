-- How far did the values spread over the whole time, beside the range that the paper found in five months?
-- A range grows with the number of values: read it with n.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- n: values
-- n_months: months in which there are values
-- mean_mm: mean value at 20 °C
-- from_review_um: mean value minus the review, in µm
-- review_expanded_uncertainty_um: expanded uncertainty of the review, in µm
-- standard_deviation_um: sample standard deviation (n - 1), in µm
-- range_um: largest minus smallest value, in µm
-- largest_month_range_um: largest range within one month, in µm
-- standard_deviation_uncompensated_um: standard deviation without temperature correction, in µm
-- range_uncompensated_um: range without temperature correction, in µm
-- coldest_c: lowest wheelset temperature, °C
-- warmest_c: highest wheelset temperature, °C
-- paper_range_um: the paper's range of this quantity and side (Fig. 2), in µm
-- paper_ratio: the paper's range divided by ours
WITH whole AS (
    SELECT
        wheelset_id,
        quantity,
        side,
        count(*) AS n,
        count(DISTINCT month) AS n_months,
        avg(value_mm) AS mean_mm,
        1000 * stddev_samp(value_mm) AS standard_deviation_um,
        CASE WHEN count(*) > 1 THEN 1000 * (max(value_mm) - min(value_mm)) END AS range_um,
        1000 * stddev_samp(value_uncompensated_mm) AS standard_deviation_uncompensated_um,
        CASE
            WHEN count(value_uncompensated_mm) > 1
                THEN 1000 * (max(value_uncompensated_mm) - min(value_uncompensated_mm))
        END AS range_uncompensated_um,
        min(wheelset_temperature_c) AS coldest_c,
        max(wheelset_temperature_c) AS warmest_c
    FROM stability_values
    GROUP BY wheelset_id, quantity, side
),

months AS (
    SELECT
        wheelset_id,
        quantity,
        side,
        max(range_um) FILTER (WHERE n > 1) AS largest_month_range_um
    FROM stability_by_month
    GROUP BY wheelset_id, quantity, side
),

paper (quantity, side, paper_range_um) AS (
    VALUES
        ('journal_diameter', 'left', 4::DOUBLE),
        ('journal_diameter', 'right', 5),
        ('wheel_diameter', 'left', 40),
        ('wheel_diameter', 'right', 30)
)

SELECT
    wheelset_id,
    quantity,
    side,
    n,
    n_months,
    mean_mm,
    1000 * (mean_mm - review_mm) AS from_review_um,
    1000 * expanded_uncertainty_mm AS review_expanded_uncertainty_um,
    standard_deviation_um,
    whole.range_um,
    largest_month_range_um,
    standard_deviation_uncompensated_um,
    range_uncompensated_um,
    coldest_c,
    warmest_c,
    paper_range_um,
    paper_range_um / nullif(whole.range_um, 0) AS paper_ratio
FROM whole
LEFT JOIN months USING (wheelset_id, quantity, side)
LEFT JOIN stability_reviews USING (wheelset_id, quantity, side)
LEFT JOIN paper USING (quantity, side)
ORDER BY wheelset_id, quantity_order(quantity), side
