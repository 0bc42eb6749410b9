-- What does the wheelset measure, with which uncertainty, and does it keep its limits? The values of its last scan that was
-- measured; where that gave none, the reason. One row for each limit that applies.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- value: value at 20 °C, in unit; null where none could be given
-- expanded_uncertainty: its expanded uncertainty U
-- unit: unit of the value
-- level: level of the limit; null where none applies
-- limit_min: smallest permitted value
-- limit_max: largest permitted value
-- verdict: conform, not_conform or undecided (ISO 14253-1); null where no limit applies
-- conform_probability: probability that the true value keeps the limits
-- limit_set: file that the limit comes from
-- source: where that has it from
-- quality_flags: conditions under which the value stands
-- reason: why there is no value
-- scan_id: scan that gave the value
-- captured_at: when the scan was taken
SELECT
    here.wheelset_id,
    here.quantity,
    here.side,
    here.value,
    here.expanded_uncertainty,
    here.unit,
    verdicts.level,
    verdicts.limit_min,
    verdicts.limit_max,
    verdicts.verdict,
    verdicts.p_conform AS conform_probability,
    verdicts.limit_set,
    verdicts.source,
    array_to_string(here.quality_flags, ', ') AS quality_flags,
    here.reason,
    here.scan_id,
    here.captured_at
FROM service_values AS here
LEFT JOIN verdicts USING (scan_id, quantity, side)
WHERE here.scan_id = getvariable('scan_id')
    OR (
        getvariable('scan_id') IS NULL
        AND (here.wheelset_id, here.captured_at) IN (
            SELECT (wheelset_id, max(captured_at)) FROM service_values GROUP BY wheelset_id
        )
    )
ORDER BY here.wheelset_id, quantity_order(here.quantity), here.quantity, here.side, level_order(verdicts.level)
