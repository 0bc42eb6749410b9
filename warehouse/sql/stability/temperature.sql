-- Does temperature still show in the values? Correlation with the wheelset's and the rig's temperature, with and without
-- compensation, and the slope against the wheelset's. A correlation is null where nothing varied.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- n: values
-- mean_wheelset_temperature_c: mean wheelset temperature, °C
-- coldest_c: lowest wheelset temperature, °C
-- warmest_c: highest wheelset temperature, °C
-- correlation_wheelset: correlation of the value with the wheelset's temperature
-- correlation_wheelset_p: its p-value against none
-- correlation_wheelset_uncompensated: the same without temperature correction
-- correlation_rig: correlation of the value with the rig's temperature
-- correlation_rig_uncompensated: the same without temperature correction
-- slope_um_per_k: change of the value with the wheelset's temperature, in µm per K
-- slope_uncompensated_um_per_k: the same without temperature correction, in µm per K
WITH courses AS (
    SELECT
        wheelset_id,
        quantity,
        side,
        1000 * (value_mm - avg(value_mm) OVER course) AS deviation_um,
        1000 * (value_uncompensated_mm - avg(value_uncompensated_mm) OVER course) AS uncompensated_um,
        wheelset_temperature_c,
        rig_temperature_c
    FROM stability_values
    WINDOW course AS (PARTITION BY wheelset_id, quantity, side)
),

correlations AS (
    SELECT
        wheelset_id,
        quantity,
        side,
        count(*) AS n,
        count(uncompensated_um) AS n_uncompensated,
        avg(wheelset_temperature_c) AS mean_wheelset_temperature_c,
        min(wheelset_temperature_c) AS coldest_c,
        max(wheelset_temperature_c) AS warmest_c,
        corr(deviation_um, wheelset_temperature_c) AS wheelset,
        corr(uncompensated_um, wheelset_temperature_c) AS wheelset_uncompensated,
        corr(deviation_um, rig_temperature_c) AS rig,
        corr(uncompensated_um, rig_temperature_c) AS rig_uncompensated,
        regr_slope(deviation_um, wheelset_temperature_c) AS slope,
        regr_slope(uncompensated_um, wheelset_temperature_c) AS slope_uncompensated
    FROM courses
    GROUP BY wheelset_id, quantity, side
    HAVING count(*) > 2
)

SELECT
    wheelset_id,
    quantity,
    side,
    n,
    mean_wheelset_temperature_c,
    coldest_c,
    warmest_c,
    CASE WHEN isfinite(wheelset) THEN wheelset END AS correlation_wheelset,
    CASE WHEN isfinite(wheelset)
        THEN student_t_p(wheelset * sqrt(n - 2) / nullif(sqrt(greatest(1 - wheelset ** 2, 0)), 0), n - 2)
    END AS correlation_wheelset_p,
    CASE WHEN isfinite(wheelset_uncompensated) AND n_uncompensated > 2
        THEN wheelset_uncompensated
    END AS correlation_wheelset_uncompensated,
    CASE WHEN isfinite(rig) THEN rig END AS correlation_rig,
    CASE WHEN isfinite(rig_uncompensated) AND n_uncompensated > 2
        THEN rig_uncompensated
    END AS correlation_rig_uncompensated,
    CASE WHEN isfinite(slope) THEN slope END AS slope_um_per_k,
    CASE WHEN isfinite(slope_uncompensated) AND n_uncompensated > 2
        THEN slope_uncompensated
    END AS slope_uncompensated_um_per_k
FROM correlations
ORDER BY wheelset_id, quantity_order(quantity), side
