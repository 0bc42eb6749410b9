-- Which values are drawn? All of a series up to 600; of a longer one every k-th, and its smallest and largest.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- captured_at: when the scan was taken
-- value_mm: value at 20 °C
-- value_uncompensated_mm: the value without temperature correction
-- n: values of the series
WITH chosen AS (
    SELECT wheelset_id
    FROM stability_over_all
    GROUP BY wheelset_id
    ORDER BY sum(n) DESC, wheelset_id
    LIMIT 12
),

numbered AS (
    SELECT
        values_here.*,
        row_number() OVER (course ORDER BY captured_at) AS i,
        count(*) OVER course AS n,
        min(value_mm) OVER course AS smallest_mm,
        max(value_mm) OVER course AS largest_mm
    FROM stability_values AS values_here
    SEMI JOIN chosen USING (wheelset_id)
    WINDOW course AS (PARTITION BY wheelset_id, quantity, side)
)

SELECT
    wheelset_id,
    quantity,
    side,
    captured_at,
    value_mm,
    value_uncompensated_mm,
    n
FROM numbered
WHERE i % greatest(1, (n / 600)::BIGINT) = 0 OR value_mm = smallest_mm OR value_mm = largest_mm
ORDER BY wheelset_id, quantity_order(quantity), side, captured_at
