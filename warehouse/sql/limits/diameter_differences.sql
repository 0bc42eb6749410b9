-- How far do the wheel diameters of a bogie, a car or a trainset lie apart, at the newest production scan of each of
-- their wheelsets, and does that keep its limits?  (The difference on one axle is a measured quantity of its own,
-- wheel_diameter_difference.)  Largest less smallest diameter; U from the two wheels that decide it, as if independent.
-- Columns
-- quantity: wheel_diameter_difference_bogie, _car or _trainset
-- trainset: Trainset that the bundles name
-- car: Car; null for a trainset
-- bogie: Bogie; null for a car or trainset
-- wheelset_type: Type of the wheelsets
-- value: Largest less smallest diameter [mm]
-- expanded_uncertainty: Expanded uncertainty of the difference [mm]
-- largest_wheelset: Wheelset of the largest diameter
-- smallest_wheelset: Wheelset of the smallest diameter
-- n_wheels: Wheels with a diameter
-- oldest: When the oldest of these scans was taken [utc]
-- level: operating, planning or after_turning; null if no limit is set
-- level_rank: 0 for the gravest level
-- limit_max: Largest permitted difference [mm]
-- verdict: conform, not_conform or undecided (ISO 14253-1)
-- p_conform: Probability that the true difference keeps the limit
-- source: Where the limit is from
-- verified: Whether the limit's source itself was seen
WITH newest AS (
    SELECT wheelset_id, max_by(scan_id, (captured_at, scan_id)) AS scan_id
    FROM measurements WHERE purpose = 'production' AND quantity = 'wheel_diameter' AND value IS NOT NULL
    GROUP BY wheelset_id
),
diameter AS (
    SELECT m.* FROM measurements m JOIN newest USING (scan_id, wheelset_id)
    WHERE m.quantity = 'wheel_diameter' AND m.value IS NOT NULL AND m.trainset IS NOT NULL
),
scoped AS (
    SELECT 'wheel_diameter_difference_bogie' AS quantity, trainset, car, bogie, * EXCLUDE (trainset, car, bogie, quantity)
    FROM diameter WHERE bogie IS NOT NULL
    UNION ALL BY NAME
    SELECT 'wheel_diameter_difference_car' AS quantity, trainset, car, NULL AS bogie, * EXCLUDE (trainset, car, bogie, quantity)
    FROM diameter WHERE car IS NOT NULL
    UNION ALL BY NAME
    SELECT 'wheel_diameter_difference_trainset' AS quantity, trainset, NULL AS car, NULL AS bogie,
        * EXCLUDE (trainset, car, bogie, quantity)
    FROM diameter
),
spread AS (
    SELECT quantity, trainset, car, bogie, min(wheelset_type) AS wheelset_type, max(value) - min(value) AS value,
        sqrt(arg_max(expanded_uncertainty, value) ** 2 + arg_min(expanded_uncertainty, value) ** 2) AS expanded_uncertainty,
        arg_max(wheelset_id, value) AS largest_wheelset, arg_min(wheelset_id, value) AS smallest_wheelset,
        count(*) AS n_wheels, min(captured_at) AS oldest
    FROM scoped GROUP BY quantity, trainset, car, bogie HAVING count(DISTINCT wheelset_id) > 1
),
typed AS (SELECT DISTINCT wheelset_type FROM limits WHERE wheelset_type IS NOT NULL)
SELECT
    s.quantity, s.trainset, s.car, s.bogie, s.wheelset_type, s.value, s.expanded_uncertainty, s.largest_wheelset,
    s.smallest_wheelset, s.n_wheels, s.oldest, l.level, l.level_rank, l.limit_max,
    CASE
        WHEN l.limit_max IS NULL THEN NULL
        WHEN s.value <= l.limit_max - s.expanded_uncertainty THEN 'conform'
        WHEN s.value > l.limit_max + s.expanded_uncertainty THEN 'not_conform'
        ELSE 'undecided'
    END AS verdict,
    normal_cdf(2 * (l.limit_max - s.value) / s.expanded_uncertainty) AS p_conform, l.source, l.verified
FROM spread s
LEFT JOIN typed t ON t.wheelset_type = s.wheelset_type
LEFT JOIN limits l ON l.quantity = s.quantity AND l.wheelset_type IS NOT DISTINCT FROM t.wheelset_type
