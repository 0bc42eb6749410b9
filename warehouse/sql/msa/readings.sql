-- Which readings enter? Production values, as deviation from the mean of their wheelset, quantity and side; the wheelset is
-- the part, the day the factor (a day has a reference scan, a temperature and often a calibration of its own).
--
-- Columns
-- scan_id: scan bundle
-- quantity: measured quantity
-- side: left, right or both
-- part: wheelset
-- factor: day
-- deviation: value less the mean of its part, in unit
-- unit: unit of the value
-- expanded_uncertainty: stated expanded uncertainty, in unit
SELECT
    scan_id,
    quantity,
    side,
    wheelset_id AS part,
    acquired_on::VARCHAR AS factor,
    value - avg(value) OVER course AS deviation,
    unit,
    expanded_uncertainty
FROM production_values
WHERE value IS NOT NULL
WINDOW course AS (
    PARTITION BY wheelset_id, quantity, side
    ORDER BY captured_at, scan_id
    ROWS BETWEEN UNBOUNDED PRECEDING AND UNBOUNDED FOLLOWING
)
ORDER BY quantity_order(quantity), quantity, side, part, captured_at, scan_id
