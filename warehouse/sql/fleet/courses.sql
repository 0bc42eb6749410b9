-- How did the deciding value of each wheelset come to where it is? Its visits, for the plots of the most urgent wheelsets.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: deciding quantity
-- side: left, right or both
-- captured_at: mean time of the visit's scans
-- value: mean value of the visit
-- expanded_uncertainty: its expanded uncertainty
-- unit: unit of the values
-- limit_value: the deciding limit
-- level: its level
-- place: place of the wheelset in the list of those to be turned
SELECT
    visits.wheelset_id,
    visits.quantity,
    visits.side,
    visits.captured_at,
    visits.value,
    visits.expanded_uncertainty,
    visits.unit,
    turning.limit_value,
    turning.level,
    turning.place
FROM fleet_visits AS visits
INNER JOIN (SELECT *, row_number() OVER () AS place FROM fleet_turning) AS turning USING (wheelset_id, quantity, side)
WHERE turning.place <= 12
ORDER BY turning.place, visits.captured_at
