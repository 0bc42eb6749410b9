-- What is to be done with this wheelset, and how sure is that?
--
-- Columns
-- wheelset_id: wheelset
-- action: what is to be done
-- probability: probability that the deciding value is beyond its limit by the end of the week; for none, that no value is
-- because: the deciding value against its limit
-- outlook: when the trend reaches the limit
-- n_limits: limits that were looked at
-- n_without_value: values with a limit that the last scan did not give though its rig can
-- last_on: day of the last scan with a value
-- trainset: trainset
-- car: car
-- axle: axle
SELECT
    wheelset_id,
    action,
    probability,
    because,
    outlook,
    n_limits,
    n_without_value,
    last_on,
    trainset,
    car,
    axle
FROM fleet_turning
