-- Which wheelsets must be turned this week, and how sure is that? One row a wheelset, the most urgent first.
-- now: beyond an operating limit by more than U (not conform). this week: an operating limit that may be exceeded by the end
-- of the week with 5 % probability or more. next visit: the same of a planning limit. no: neither.
-- What a lathe cannot mend (a distance, a journal, a wheel that is too small) says workshop instead of turn.
--
-- Columns
-- wheelset_id: wheelset
-- action: turn now, turn this week, turn at next visit, workshop now, workshop this week, workshop at next visit, none, or measure again
-- probability: probability that the deciding value is beyond its limit by the end of the week; for none, that no value is
-- because: the deciding value against its limit
-- outlook: when the trend reaches the limit
-- quantity: deciding quantity
-- side: its side
-- level: deciding level
-- value_now: estimate of the deciding value for the report's day
-- value_in_a_week: the same seven days later
-- expanded_uncertainty_in_a_week: its expanded uncertainty
-- limit_value: the limit
-- unit: unit of the values
-- n_limits: limits that were looked at
-- n_without_value: values with a limit of any kind in the fleet that this wheelset's last scan did not give though its rig can
-- last_on: day of its last scan with a value
-- age_days: days since then
-- trainset: trainset
-- car: car
-- axle: axle
WITH rated AS (
    SELECT
        forecast.*,
        state.verdict,
        state.conform_probability,
        CASE
            WHEN forecast.level = 'operating' AND state.verdict = 'not_conform' AND forecast.margin < 0 THEN 0
            WHEN forecast.level = 'operating' AND forecast.beyond_in_a_week_probability >= 0.05 THEN 1
            WHEN forecast.level = 'planning' AND forecast.beyond_in_a_week_probability >= 0.05 THEN 2
            ELSE 3
        END AS urgency,
        forecast.quantity LIKE 'journal%' OR forecast.quantity LIKE '%distance' OR forecast.quantity = 'rim_width'
        OR (forecast.quantity IN ('wheel_diameter', 'tape_diameter') AND forecast.bound = 'min') AS workshop
    FROM fleet_forecasts AS forecast
    INNER JOIN fleet_state AS state USING (wheelset_id, quantity, side, level)
),

deciding AS (
    SELECT
        *,
        count(*) OVER (PARTITION BY wheelset_id) AS n_limits
    FROM rated
    QUALIFY row_number() OVER (
        PARTITION BY wheelset_id
        ORDER BY
            urgency,
            beyond_in_a_week_probability DESC,
            margin / expanded_uncertainty_in_a_week,
            quantity_order(quantity),
            quantity,
            side,
            level,
            bound
    ) = 1
),

wheelsets AS (
    SELECT
        wheelset_id,
        max(measured_on) AS last_on,
        min(age_days) AS age_days,
        arg_max(trainset, measured_on) AS trainset,
        arg_max(car, measured_on) AS car,
        arg_max(axle, measured_on) AS axle
    FROM fleet_state
    GROUP BY wheelset_id
),

missing AS (
    SELECT
        wheelset_id,
        count(*) AS n_without_value
    FROM (
        SELECT *
        FROM service_values
        QUALIFY rank() OVER (PARTITION BY wheelset_id ORDER BY captured_at DESC, scan_id DESC) = 1
    ) AS last_scan
    WHERE value IS NULL AND quantity IN (SELECT quantity FROM limits)
        AND NOT EXISTS (
            FROM fleet_unseen AS unseen
            WHERE unseen.rig_id = last_scan.rig_id AND unseen.quantity = last_scan.quantity AND unseen.side = last_scan.side
        )
    GROUP BY wheelset_id
)

SELECT
    wheelsets.wheelset_id,
    CASE
        WHEN urgency IS NULL THEN 'no limit applies'
        WHEN urgency = 3 AND n_without_value > 0 THEN 'measure again'
        WHEN urgency = 3 THEN 'none'
        ELSE CASE WHEN workshop THEN 'workshop ' ELSE 'turn ' END
            || list_extract(['now', 'this week', 'at next visit'], urgency + 1)
    END AS action,
    CASE WHEN urgency = 3 THEN 1 - beyond_in_a_week_probability ELSE beyond_in_a_week_probability END AS probability,
    CASE
        WHEN urgency IS NULL THEN NULL
        ELSE CASE WHEN urgency = 3 THEN 'nearest: ' ELSE '' END
            || replace(quantity, '_', ' ') || CASE side WHEN 'both' THEN ' ' ELSE ' ' || side || ' ' END
            || printf('%.3f ± %.3f %s', value_in_a_week, expanded_uncertainty_in_a_week, unit)
            || CASE WHEN verdict IS NULL THEN '' ELSE ' (now ' || replace(verdict, '_', ' ') || ')' END
            || CASE bound WHEN 'max' THEN ', at most ' ELSE ', at least ' END
            || printf('%.3f %s (%s)', limit_value, unit, level)
    END AS because,
    outlook,
    quantity,
    side,
    level,
    value_now,
    value_in_a_week,
    expanded_uncertainty_in_a_week,
    limit_value,
    unit,
    coalesce(n_limits, 0) AS n_limits,
    coalesce(n_without_value, 0) AS n_without_value,
    wheelsets.last_on,
    wheelsets.age_days,
    wheelsets.trainset,
    wheelsets.car,
    wheelsets.axle
FROM wheelsets
LEFT JOIN deciding USING (wheelset_id)
LEFT JOIN missing USING (wheelset_id)
ORDER BY coalesce(urgency, 9), beyond_in_a_week_probability DESC NULLS LAST, wheelsets.wheelset_id
