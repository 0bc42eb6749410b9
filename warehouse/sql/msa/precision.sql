-- How well do readings repeat, within a day and between days (ISO 5725-2, the day as the laboratory, the wheelsets pooled)?
-- Wear between the days counts as reproducibility here; a campaign of one or two weeks tells the gauge alone. Unequal days
-- enter with the effective number of readings. Beside it the scatter that the stated uncertainties leave room for.
--
-- Columns
-- quantity: measured quantity
-- side: left, right or both
-- n_parts: wheelsets measured on two days or more
-- n_days: days
-- n: readings
-- repeatability_um: standard deviation within a day s_r, in µm
-- between_days_um: standard deviation between days s_L, in µm
-- reproducibility_um: standard deviation over days s_R, in µm
-- repeatability_limit_um: r = 2.8 s_r: two readings of a day differ by more in 5 % of cases
-- reproducibility_limit_um: R = 2.8 s_R: two readings of different days differ by more in 5 % of cases
-- f: mean square between days over that within
-- f_df_between: its degrees of freedom between days
-- f_df_within: its degrees of freedom within days
-- stated_um: root mean square of the stated standard uncertainties U / 2, in µm
-- reproducibility_share: reproducibility over the stated standard uncertainty; above 1 the statement is too small
WITH parts AS (
    SELECT quantity, side, part, count(*) AS n_cells, sum(n) AS n, sum(n * n) AS n2
    FROM msa_cells
    GROUP BY quantity, side, part
    HAVING count(*) > 1
),

squares AS (
    SELECT
        quantity,
        side,
        count(DISTINCT part) AS n_parts,
        count(DISTINCT factor) AS n_days,
        sum(cells.n)::BIGINT AS n,
        count(*) - count(DISTINCT part) AS df_between,
        (sum(cells.n) - count(*))::BIGINT AS df_within,
        sum(cells.n * deviation_um ** 2) AS ss_between,
        coalesce(sum((cells.n - 1) * standard_deviation_um ** 2), 0) AS ss_within
    FROM msa_cells AS cells
    INNER JOIN parts USING (quantity, side, part)
    GROUP BY quantity, side
),

sizes AS (
    SELECT quantity, side, sum(n - n2 / n) AS effective
    FROM parts
    GROUP BY quantity, side
),

stated AS (
    SELECT quantity, side, 1000 * sqrt(avg((expanded_uncertainty / 2) ** 2)) AS stated_um
    FROM msa_readings
    GROUP BY quantity, side
),

components AS (
    SELECT
        *,
        ss_within / df_within AS ms_within,
        ss_between / df_between AS ms_between,
        greatest((ss_between / df_between - ss_within / df_within) / (effective / df_between), 0) AS variance_between
    FROM squares
    INNER JOIN sizes USING (quantity, side)
    WHERE df_within > 0
)

SELECT
    quantity,
    side,
    n_parts,
    n_days,
    n,
    sqrt(ms_within) AS repeatability_um,
    sqrt(variance_between) AS between_days_um,
    sqrt(ms_within + variance_between) AS reproducibility_um,
    2.8 * repeatability_um AS repeatability_limit_um,
    2.8 * reproducibility_um AS reproducibility_limit_um,
    ms_between / nullif(ms_within, 0) AS f,
    df_between AS f_df_between,
    df_within AS f_df_within,
    stated_um,
    reproducibility_um / nullif(stated_um, 0) AS reproducibility_share
FROM components
INNER JOIN stated USING (quantity, side)
ORDER BY quantity_order(quantity), quantity, side
