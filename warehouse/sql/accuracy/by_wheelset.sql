-- How do the errors lie wheelset by wheelset? One wheelset's repeats mostly share a review, whose own error then shows
-- as that wheelset's bias.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- n: pairs of a value and a review
-- n_reviews: different reviews among them
-- mean_measured_mm: mean of the measured values
-- mean_reference_mm: mean of the reviews they were compared with
-- bias_um: mean error, measured minus reference, in µm
-- standard_deviation_um: sample standard deviation of the errors (n - 1), in µm
-- max_error_um: largest absolute error, in µm
-- mean_e_n: mean E_n
-- max_e_n: largest absolute E_n
-- farthest_days: longest time between a scan and its review, in days
-- first_at: first scan
-- last_at: last scan
SELECT
    wheelset_id,
    quantity,
    side,
    count(*) AS n,
    count(DISTINCT (reference_measured_at, reference_mm)) AS n_reviews,
    avg(measured_mm) AS mean_measured_mm,
    avg(reference_mm) AS mean_reference_mm,
    avg(error_um) AS bias_um,
    stddev_samp(error_um) AS standard_deviation_um,
    max(abs(error_um)) AS max_error_um,
    avg(e_n) AS mean_e_n,
    max(abs(e_n)) AS max_e_n,
    max(abs(days_to_reference)) AS farthest_days,
    min(captured_at) AS first_at,
    max(captured_at) AS last_at
FROM accuracy_pairs
GROUP BY wheelset_id, quantity, side
ORDER BY wheelset_id, quantity_order(quantity), quantity, side
