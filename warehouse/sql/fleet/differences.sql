-- How far do the wheel diameters lie apart on each axle, bogie, car and trainset, and do they keep their limits? Largest
-- less smallest, at the last scan of each wheelset.
--
-- Columns
-- scope: axle, bogie, car or trainset
-- trainset: trainset
-- car: car
-- bogie: bogie
-- wheelset_id: wheelset, for an axle; else those of the largest and of the smallest diameter
-- n_wheels: wheels with a diameter
-- value: difference, in unit
-- expanded_uncertainty: its expanded uncertainty
-- unit: unit of the difference
-- level: level of the limit; null where none applies
-- limit_max: largest permitted difference
-- verdict: conform, not_conform or undecided; null where no limit applies
-- conform_probability: probability that the true difference keeps the limit
-- source: where the limit is from
SELECT
    'axle' AS scope,
    trainset,
    car,
    bogie,
    wheelset_id,
    2::BIGINT AS n_wheels,
    value,
    expanded_uncertainty,
    unit,
    level,
    limit_max,
    verdict,
    conform_probability,
    source
FROM fleet_state
WHERE quantity = 'wheel_diameter_difference'
UNION ALL
SELECT
    replace(quantity, 'wheel_diameter_difference_', '') AS scope,
    trainset,
    car,
    bogie,
    largest_wheelset || ' / ' || smallest_wheelset AS wheelset_id,
    n_wheels,
    value,
    expanded_uncertainty,
    'mm' AS unit,
    level,
    limit_max,
    verdict,
    p_conform AS conform_probability,
    source
FROM diameter_differences
ORDER BY list_position(['axle', 'bogie', 'car', 'trainset'], scope), trainset, car, bogie, wheelset_id, level_order(level)
