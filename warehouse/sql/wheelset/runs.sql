-- How large are run-out and roundness over the turn that was plotted? Largest less smallest over the frames that were used;
-- noise counts here, so that these are a little above the values in the table.
--
-- Columns
-- scan_id: scan bundle
-- side: left or right
-- series: tread_radius, face_lateral, journal_radius or shoulder_lateral
-- n: frames used
-- n_left_out: frames left out as dirt or reflection
-- runout_um: largest less smallest deviation, in µm
-- roundness_um: the same without the first harmonic, in µm
-- fitted_runout_um: largest less smallest of the fitted harmonics, in µm
-- noise_um: standard deviation of the frames about the fit, in µm
SELECT
    scan_id,
    side,
    series,
    count(*) FILTER (WHERE used) AS n,
    count(*) FILTER (WHERE NOT used) AS n_left_out,
    max(deviation_um) FILTER (WHERE used) - min(deviation_um) FILTER (WHERE used) AS runout_um,
    max(roundness_um) FILTER (WHERE used) - min(roundness_um) FILTER (WHERE used) AS roundness_um,
    max(fitted_um) FILTER (WHERE used) - min(fitted_um) FILTER (WHERE used) AS fitted_runout_um,
    stddev_samp(deviation_um - fitted_um) FILTER (WHERE used) AS noise_um
FROM wheelset_turns
GROUP BY scan_id, side, series
ORDER BY
    list_position(['tread_radius', 'face_lateral', 'journal_radius', 'shoulder_lateral'], series::VARCHAR), side
