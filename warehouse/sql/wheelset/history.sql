-- How did the values come to where they are? The mean of every visit (a day), oldest first, with the limits that now apply.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- visited_on: day of the visit
-- captured_at: mean time of its scans
-- n: values
-- value: mean value at 20 °C, in unit
-- expanded_uncertainty: expanded uncertainty of one value
-- unit: unit of the value
-- mileage_km: mileage, where the bundle names it
-- n_turnings: turnings seen before this visit
-- limit_min: smallest value permitted in operation
-- limit_max: largest value permitted in operation
SELECT
    wheelset_id,
    quantity,
    side,
    visited_on,
    captured_at,
    n,
    value,
    expanded_uncertainty,
    unit,
    mileage_km,
    n_turnings,
    limit_min,
    limit_max
FROM fleet_visits
LEFT JOIN (
    SELECT
        wheelset_id,
        quantity,
        side,
        max(limit_min) AS limit_min,
        min(limit_max) AS limit_max
    FROM fleet_state
    WHERE level = 'operating'
    GROUP BY wheelset_id, quantity, side
) USING (wheelset_id, quantity, side)
ORDER BY wheelset_id, quantity_order(quantity), quantity, side, visited_on
