-- What does the uncertainty of each value of the last scan rest on? The three largest sources of each.
--
-- Columns
-- quantity: measured quantity
-- side: left, right or both
-- source: source of uncertainty
-- standard_uncertainty: standard uncertainty of the source, in source_unit
-- source_unit: unit of the source
-- contribution_um: standard uncertainty of the value from this source, in µm (or in thousandths of the value's unit)
-- share: share of the value's variance
SELECT
    quantity,
    side,
    source,
    standard_uncertainty,
    source_unit,
    1000 * contribution AS contribution_um,
    share
FROM budgets
WHERE scan_id = getvariable('scan_id')
QUALIFY row_number() OVER (PARTITION BY quantity, side ORDER BY share DESC, source) <= 3
ORDER BY quantity_order(quantity), quantity, side, share DESC, source
