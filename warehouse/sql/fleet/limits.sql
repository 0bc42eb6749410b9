-- Which limits apply to the types of wheelsets that were measured, and where are they from? A limit that is not verified is an example: check it first.
--
-- Columns
-- limit_set: file that the limit comes from
-- wheelset_type: type of wheelset that it is for; null for any other
-- quantity: measured quantity
-- side: side; null for every side
-- level: operating, planning or after_turning
-- limit_min: smallest permitted value
-- limit_max: largest permitted value
-- diameter_min_mm: holds for wheels above this diameter
-- diameter_max_mm: holds for wheels up to this diameter
-- verified: whether the source itself was seen
-- source: where the limit is from
SELECT
    limit_set,
    wheelset_type,
    quantity,
    side,
    level,
    limit_min,
    limit_max,
    diameter_min_mm,
    diameter_max_mm,
    verified,
    source
FROM limits
WHERE wheelset_type IN (SELECT wheelset_type FROM measurements)
    OR (
        wheelset_type IS NULL
        AND EXISTS (
            FROM measurements
            WHERE wheelset_type NOT IN (SELECT limits.wheelset_type FROM limits WHERE limits.wheelset_type IS NOT NULL)
        )
    )
ORDER BY limit_set, wheelset_type, level_rank, quantity_order(quantity), quantity, side, diameter_min_mm
