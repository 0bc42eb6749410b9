-- Can the gauge tell wheelsets apart, and is it good enough for the limits? Gauge is repeatability and between-day scatter
-- together; parts differ by what their means show beyond that. Tolerance: the narrowest two-sided limit of any level.
--
-- Columns
-- quantity: measured quantity
-- side: left, right or both
-- n_parts: wheelsets
-- gauge_um: standard deviation of the gauge, in µm
-- part_um: standard deviation between wheelsets, in µm
-- total_um: both together, in µm
-- grr_percent: gauge over total, in %
-- n_distinct: number of distinct categories, 1.41 part / gauge (5 or more is wanted), not rounded
-- tolerance: largest less smallest permitted value, in the quantity's unit; null without a two-sided limit
-- grr_percent_of_tolerance: 6 gauge over the tolerance, in % (10 or less is good, 30 the most)
-- uncertainty_percent_of_tolerance: 2 U over the tolerance, in % (VDA 5: at most 30)
-- cg: 0.2 tolerance / 6 s_r, the type-1 study's capability with wheelsets in place of a standard
WITH means AS (
    SELECT
        quantity,
        side,
        wheelset_id AS part,
        avg(value) AS mean,
        count(*) AS n,
        count(DISTINCT acquired_on) AS n_days
    FROM production_values
    WHERE value IS NOT NULL
    GROUP BY quantity, side, wheelset_id
),

parts AS (
    SELECT
        quantity,
        side,
        count(*) AS n_parts,
        1e6 * var_samp(mean) AS variance_means,
        avg(1.0 / n) AS inverse_n,
        avg(1.0 / n_days) AS inverse_days
    FROM means
    GROUP BY quantity, side
    HAVING count(*) > 1
),

components AS (
    SELECT
        *,
        reproducibility_um AS gauge_um,
        sqrt(greatest(variance_means - repeatability_um ** 2 * inverse_n - between_days_um ** 2 * inverse_days, 0))
            AS part_um
    FROM parts
    INNER JOIN (SELECT * EXCLUDE (n_parts) FROM msa_precision) USING (quantity, side)
),

tolerances AS (
    SELECT
        quantity,
        side,
        min(limit_max - limit_min) AS tolerance
    FROM verdicts
    WHERE limit_min IS NOT NULL AND limit_max IS NOT NULL
    GROUP BY quantity, side
)

SELECT
    quantity,
    side,
    n_parts,
    gauge_um,
    part_um,
    sqrt(gauge_um ** 2 + part_um ** 2) AS total_um,
    100 * gauge_um / nullif(total_um, 0) AS grr_percent,
    sqrt(2) * part_um / nullif(gauge_um, 0) AS n_distinct,
    tolerance,
    100 * 6 * gauge_um / (1000 * tolerance) AS grr_percent_of_tolerance,
    100 * 4 * stated_um / (1000 * tolerance) AS uncertainty_percent_of_tolerance,
    0.2 * 1000 * tolerance / (6 * nullif(repeatability_um, 0)) AS cg
FROM components
LEFT JOIN tolerances USING (quantity, side)
ORDER BY quantity_order(quantity), quantity, side
