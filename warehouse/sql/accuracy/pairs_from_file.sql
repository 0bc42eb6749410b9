-- How far is each value of the file from its reference? One row for each line of the file.
--
-- Columns
-- scan_id: identifier given in the file, or the line's number
-- wheelset_id: wheelset, where the file names one
-- captured_at: unknown for values from a file
-- quantity: measured quantity
-- side: left, right or both
-- measured_mm: measured value
-- expanded_uncertainty_mm: expanded uncertainty U of the measured value
-- reference_mm: reference value
-- reference_expanded_uncertainty_mm: expanded uncertainty U of the reference; taken as exact where the file has none
-- reference_measured_at: unknown for values from a file
-- reference_instrument: unknown for values from a file
-- days_to_reference: unknown for values from a file
-- mean_mm: mean of measured and reference
-- error_um: measured minus reference, in µm
-- e_n: error divided by the root sum of squares of both expanded uncertainties; within ±1 the two agree
SELECT
    coalesce(scan_id, 'line ' || line) AS scan_id,
    wheelset_id,
    NULL::TIMESTAMPTZ AS captured_at,
    quantity,
    side,
    measured_mm,
    expanded_uncertainty_mm,
    reference_mm,
    reference_expanded_uncertainty_mm,
    NULL::TIMESTAMPTZ AS reference_measured_at,
    NULL::VARCHAR AS reference_instrument,
    NULL::DOUBLE AS days_to_reference,
    (measured_mm + reference_mm) / 2 AS mean_mm,
    1000 * (measured_mm - reference_mm) AS error_um,
    (measured_mm - reference_mm)
    / nullif(sqrt(expanded_uncertainty_mm ** 2 + coalesce(reference_expanded_uncertainty_mm, 0) ** 2), 0) AS e_n
FROM pairs_file
ORDER BY quantity_order(quantity), quantity, side, line
