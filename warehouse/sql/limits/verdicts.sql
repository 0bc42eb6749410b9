-- Does a measured value keep its limits, and how sure is that?  Decision rule of ISO 14253-1 with the expanded
-- uncertainty as guard band: conform only where the value keeps the limit with all of U, not_conform only where it breaks
-- it with all of U, undecided between. Limits of the set that names the wheelset's type, else of the sets for any type.
-- Columns
-- scan_id: Scan bundle that the row comes from
-- wheelset_id: Wheelset that was measured
-- purpose: production, or reference for the master wheelset
-- captured_at: When the scan was taken [utc]
-- quantity: Measured quantity
-- side: left, right, or both for a distance across the wheelset
-- value: Value at 20 °C, in `unit`
-- unit: Unit of value, uncertainty and limits
-- expanded_uncertainty: Expanded uncertainty U = k u
-- level: operating, planning or after_turning
-- level_rank: 0 for the gravest level
-- limit_min: Smallest permitted value; null if there is none
-- limit_max: Largest permitted value; null if there is none
-- margin: Distance of the value from the nearer limit, negative beyond it
-- verdict: conform, not_conform, or undecided
-- p_conform: Probability that the true value keeps the limits, for a normal distribution about the value
-- limit_set: File that the limit comes from
-- source: Where the limit is from
-- verified: Whether the limit's source itself was seen
WITH value AS (
    SELECT *, expanded_uncertainty / coverage_factor AS u,
        max(value) FILTER (quantity = 'wheel_diameter') OVER (PARTITION BY scan_id) AS diameter_mm
    FROM measurements
),
typed AS (SELECT DISTINCT wheelset_type FROM limits WHERE wheelset_type IS NOT NULL)
SELECT
    m.scan_id, m.wheelset_id, m.purpose, m.captured_at, m.quantity, m.side, m.value, m.unit, m.expanded_uncertainty,
    l.level, l.level_rank, l.limit_min, l.limit_max,
    least(coalesce(m.value - l.limit_min, 'infinity'::DOUBLE), coalesce(l.limit_max - m.value, 'infinity'::DOUBLE)) AS margin,
    CASE
        WHEN margin >= m.expanded_uncertainty THEN 'conform'
        WHEN margin < -m.expanded_uncertainty THEN 'not_conform'
        ELSE 'undecided'
    END AS verdict,
    greatest(0.0, coalesce(normal_cdf((l.limit_max - m.value) / m.u), 1.0)
        - coalesce(normal_cdf((l.limit_min - m.value) / m.u), 0.0)) AS p_conform,
    l.limit_set, l.source, l.verified
FROM value m
LEFT JOIN typed t ON t.wheelset_type = m.wheelset_type
JOIN limits l
    ON l.quantity = m.quantity
    AND l.wheelset_type IS NOT DISTINCT FROM t.wheelset_type
    AND coalesce(l.side, m.side) = m.side
    AND (l.diameter_min_mm IS NULL OR m.diameter_mm > l.diameter_min_mm)
    AND (l.diameter_max_mm IS NULL OR m.diameter_mm <= l.diameter_max_mm)
WHERE m.value IS NOT NULL
