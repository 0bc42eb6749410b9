-- How round is it, and how true does it run? Frame by frame over the turn of the last scan: deviation from the mean (what
-- counts as run-out), and the same without the first harmonic (roundness: an off-centre circle is no fault of the shape).
-- Frames that were left out as dirt or reflection stay in with used = false.
--
-- Columns
-- scan_id: scan bundle
-- side: left or right
-- series: tread_radius, face_lateral, journal_radius or shoulder_lateral
-- angle_deg: angle of the turn
-- deviation_um: deviation from the mean over the turn, in µm
-- roundness_um: the same without the first harmonic, in µm
-- fitted_um: fitted harmonics at this angle, as deviation from the mean, in µm
-- used: whether the frame entered the fit
WITH frames AS (
    SELECT
        turns.scan_id,
        alignments.side,
        turns.station,
        turns.series,
        turns.angle_deg,
        turns.value_mm,
        turns.fitted_mm,
        turns.used
    FROM turns
    INNER JOIN alignments ON alignments.scan_id = turns.scan_id AND alignments.station = turns.station
    WHERE turns.scan_id = getvariable('scan_id')
),

means AS (
    SELECT
        scan_id,
        station,
        series,
        avg(value_mm) FILTER (WHERE used) AS mean_mm,
        2 * avg(value_mm * cos(radians(angle_deg))) FILTER (WHERE used)
        - 2 * avg(value_mm) FILTER (WHERE used) * avg(cos(radians(angle_deg))) FILTER (WHERE used) AS cosine_mm,
        2 * avg(value_mm * sin(radians(angle_deg))) FILTER (WHERE used)
        - 2 * avg(value_mm) FILTER (WHERE used) * avg(sin(radians(angle_deg))) FILTER (WHERE used) AS sine_mm
    FROM frames
    GROUP BY scan_id, station, series
)

SELECT
    scan_id,
    side,
    series,
    angle_deg,
    1000 * (value_mm - mean_mm) AS deviation_um,
    1000 * (value_mm - mean_mm - cosine_mm * cos(radians(angle_deg)) - sine_mm * sin(radians(angle_deg)))
        AS roundness_um,
    1000 * (fitted_mm - mean_mm) AS fitted_um,
    used
FROM frames
INNER JOIN means USING (scan_id, station, series)
ORDER BY
    list_position(['tread_radius', 'face_lateral', 'journal_radius', 'shoulder_lateral'], series::VARCHAR),
    side,
    angle_deg
