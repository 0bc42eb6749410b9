-- What did each visit find? A visit is all scans of a wheelset on one day; its value is their mean. Scans of a day share
-- reference, calibration and temperature, so the mean's U is no smaller than that of one scan. A wheelset counts as turned
-- (or given new wheels) between two visits if a flange became lower by more than 0.3 mm, or a wheel larger by as much:
-- wear does neither. Trends begin anew there.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- visited_on: day of the visit
-- captured_at: mean time of its scans
-- n: values
-- value: mean value at 20 °C, in unit
-- expanded_uncertainty: mean expanded uncertainty of one value, in unit
-- unit: unit of the value
-- mileage_km: mileage at the visit, in km, where the bundle names it
-- n_turnings: turnings seen before this visit
-- last_visit: whether this is the wheelset's last visit with a value of this quantity
WITH days AS (
    SELECT
        wheelset_id,
        quantity,
        side,
        acquired_on AS visited_on,
        make_timestamptz(avg(epoch_us(captured_at))::BIGINT) AS captured_at,
        count(*) AS n,
        avg(value) AS value,
        avg(expanded_uncertainty) AS expanded_uncertainty,
        any_value(unit) AS unit,
        max(mileage_km) AS mileage_km
    FROM service_values
    WHERE value IS NOT NULL
    GROUP BY wheelset_id, quantity, side, acquired_on
),

steps AS (
    SELECT
        wheelset_id,
        visited_on,
        quantity,
        value - lag(value) OVER (PARTITION BY wheelset_id, quantity, side ORDER BY visited_on) AS step,
        3 * expanded_uncertainty AS sure
    FROM days
    WHERE quantity IN ('flange_height', 'wheel_diameter')
),

turnings AS (
    SELECT DISTINCT wheelset_id, visited_on AS turned_by
    FROM steps
    WHERE abs(step) > greatest(0.3, sure)
        AND ((quantity = 'flange_height' AND step < 0) OR (quantity = 'wheel_diameter' AND step > 0))
),

counted AS (
    SELECT
        days.*,
        (
            SELECT count(*)
            FROM turnings
            WHERE turnings.wheelset_id = days.wheelset_id AND turnings.turned_by <= days.visited_on
        ) AS n_turnings
    FROM days
)

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
    visited_on = max(visited_on) OVER (PARTITION BY wheelset_id, quantity, side) AS last_visit
FROM counted
ORDER BY wheelset_id, quantity_order(quantity), quantity, side, visited_on
