-- What did each day say of each wheelset? Mean and scatter of the readings in a cell.
--
-- Columns
-- quantity: measured quantity
-- side: left, right or both
-- part: wheelset
-- factor: day
-- n: readings
-- deviation_um: mean deviation from the part's mean, in µm (or thousandths of the unit)
-- standard_deviation_um: standard deviation within the cell, in µm
-- standard_error_um: standard error of the mean, in µm
SELECT
    quantity,
    side,
    part,
    factor,
    count(*) AS n,
    1000 * avg(deviation) AS deviation_um,
    1000 * stddev_samp(deviation) AS standard_deviation_um,
    1000 * stddev_samp(deviation) / sqrt(count(*)) AS standard_error_um
FROM msa_readings
GROUP BY quantity, side, part, factor
ORDER BY quantity_order(quantity), quantity, side, part, factor
