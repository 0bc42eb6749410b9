-- What does the profile look like beside the nominal one? The mean meridian of each wheel over the turn of the last scan, in
-- bins of half a millimetre, aligned to the nominal by inner face and flange's top.
--
-- Columns
-- scan_id: scan bundle
-- side: left or right
-- lateral_mm: from the datum circle, positive to the field side
-- height_mm: above the tread at the datum circle
-- deviation_um: distance from the nominal profile along its normal, positive for more metal, in µm
-- n: points of the bin
SELECT
    profiles.scan_id,
    alignments.side,
    round(2 * (profiles.from_inner_face_mm - 70)) / 2 AS lateral_mm,
    avg(profiles.height_mm) AS height_mm,
    avg(profiles.deviation_um) AS deviation_um,
    count(*) AS n
FROM wheel_profiles AS profiles
INNER JOIN alignments ON alignments.scan_id = profiles.scan_id AND alignments.station = profiles.station
WHERE profiles.scan_id = getvariable('scan_id')
    AND profiles.height_mm IS NOT NULL
    AND profiles.from_inner_face_mm > 1
GROUP BY profiles.scan_id, alignments.side, lateral_mm
ORDER BY alignments.side, lateral_mm
