-- In which state is every wheelset: its last value of every quantity, against the limits of every level that apply to it?
-- Verdicts follow ISO 14253-1: conform or not conform only where U leaves no doubt, else undecided.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- value: last value at 20 °C, in unit
-- expanded_uncertainty: its expanded uncertainty U
-- unit: unit of the value
-- level: level of the limit; null where none applies
-- limit_min: smallest permitted value
-- limit_max: largest permitted value
-- verdict: conform, not_conform or undecided; null where no limit applies
-- conform_probability: probability that the true value lies within the limits
-- source: where the limit is from
-- measured_on: day of the scan
-- age_days: days from then to the report's day
-- scan_id: scan that gave the value
-- trainset: trainset
-- car: car
-- bogie: bogie
-- axle: axle
-- quality_flags: conditions under which the value stands
WITH latest AS (
    SELECT *
    FROM service_values
    WHERE value IS NOT NULL
    QUALIFY row_number() OVER (
        PARTITION BY wheelset_id, quantity, side ORDER BY captured_at DESC, scan_id DESC
    ) = 1
)
SELECT
    latest.wheelset_id,
    latest.quantity,
    latest.side,
    latest.value,
    latest.expanded_uncertainty,
    latest.unit,
    verdicts.level,
    verdicts.limit_min,
    verdicts.limit_max,
    verdicts.verdict,
    verdicts.p_conform AS conform_probability,
    verdicts.source,
    latest.acquired_on AS measured_on,
    (SELECT as_of FROM fleet_day) - latest.acquired_on AS age_days,
    latest.scan_id,
    latest.trainset,
    latest.car,
    latest.bogie,
    latest.axle,
    array_to_string(latest.quality_flags, ', ') AS quality_flags
FROM latest
LEFT JOIN verdicts USING (scan_id, quantity, side)
ORDER BY
    latest.wheelset_id,
    level_order(verdicts.level),
    quantity_order(latest.quantity),
    latest.quantity,
    latest.side
