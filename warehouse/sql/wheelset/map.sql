-- Where on the wheel is there more or less metal than on the mean of its turn? The unrolled surface of each wheel of the last
-- scan as deviation from its own mean meridian, along the normal, in bins of 2.5 degrees and of the stored lateral width:
-- run-out shows as a wave along the turn, a flat or dirt as a patch.
--
-- Columns
-- scan_id: scan bundle
-- side: left or right
-- angle_deg: angle of the turn, middle of the bin
-- lateral_mm: from the datum circle, positive to the field side, middle of the bin
-- deviation_um: mean deviation, positive for more metal, in µm
-- n: points of the bin
SELECT
    maps.scan_id,
    alignments.side,
    2.5 * (floor(maps.angle_deg / 2.5) + 0.5) AS angle_deg,
    maps.from_inner_face_mm - 70 AS lateral_mm,
    sum(maps.deviation_um * maps.n_points) / sum(maps.n_points) AS deviation_um,
    sum(maps.n_points) AS n
FROM tread_maps AS maps
INNER JOIN alignments ON alignments.scan_id = maps.scan_id AND alignments.station = maps.station
WHERE maps.scan_id = getvariable('scan_id')
GROUP BY maps.scan_id, alignments.side, floor(maps.angle_deg / 2.5), maps.from_inner_face_mm
ORDER BY alignments.side, lateral_mm, angle_deg
