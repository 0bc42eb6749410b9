-- How large are the errors of each quantity, and do they agree with the uncertainties that both sides state?
-- The interval of the bias holds the scatter of the mean and the review's own uncertainty. The latter enters whole:
-- repeats share one review, so that averaging them does not make it smaller. Degrees of freedom by Welch-Satterthwaite,
-- rounded down.
--
-- Columns
-- quantity: measured quantity
-- side: left, right or both
-- n: pairs of a value and a review
-- n_wheelsets: wheelsets among them
-- n_reviews: different reviews among them
-- bias_um: mean error, measured minus reference, in µm
-- bias_low_um: lower end of the bias's 95 % interval, in µm
-- bias_high_um: upper end of the bias's 95 % interval, in µm
-- standard_deviation_um: sample standard deviation of the errors (n - 1), in µm
-- u_reference_um: standard uncertainty of the reviews (mean of U / 2), in µm
-- max_error_um: largest absolute error, in µm
-- mean_expanded_uncertainty_um: mean expanded uncertainty of the measured values, in µm
-- mean_e_n: mean E_n
-- max_e_n: largest absolute E_n
-- within_ratio: share of the pairs with |E_n| of at most 1
-- verdict: agrees, biased, disagrees, unbiased (no uncertainty stated) or too few, by the rule stated with the block
-- paper_error_um: the paper's largest error of this quantity (Table 1), in µm
-- paper_ratio: the paper's largest error divided by ours
WITH errors AS (
    SELECT
        quantity,
        side,
        count(*) AS n,
        count(DISTINCT wheelset_id) AS n_wheelsets,
        count(DISTINCT (wheelset_id, reference_measured_at, reference_mm)) AS n_reviews,
        avg(error_um) AS bias_um,
        stddev_samp(error_um) AS standard_deviation_um,
        1000 * avg(reference_expanded_uncertainty_mm) / 2 AS u_reference_um,
        max(abs(error_um)) AS max_error_um,
        1000 * avg(expanded_uncertainty_mm) AS mean_expanded_uncertainty_um,
        avg(e_n) AS mean_e_n,
        max(abs(e_n)) AS max_e_n,
        count(e_n) AS n_e_n,
        count(*) FILTER (WHERE abs(e_n) > 1) AS n_outside
    FROM accuracy_pairs
    GROUP BY quantity, side
),

bias AS (
    SELECT
        *,
        standard_deviation_um / sqrt(n) AS u_mean_um,
        sqrt(standard_deviation_um ** 2 / n + coalesce(u_reference_um, 0) ** 2) AS u_bias_um
    FROM errors
),

intervals AS (
    SELECT
        *,
        u_bias_um * student_t_95(
            CASE WHEN u_mean_um = 0 THEN 1e6 ELSE least(1e6, floor((n - 1) * (u_bias_um / u_mean_um) ** 4 + 1e-9)) END
        ) AS half_um
    FROM bias
),

paper (quantity, paper_error_um) AS (
    VALUES ('journal_diameter', 3::DOUBLE), ('wheel_diameter', 40), ('inner_distance', 20)
)

SELECT
    quantity,
    side,
    n,
    n_wheelsets,
    n_reviews,
    bias_um,
    bias_um - half_um AS bias_low_um,
    bias_um + half_um AS bias_high_um,
    standard_deviation_um,
    u_reference_um,
    max_error_um,
    mean_expanded_uncertainty_um,
    mean_e_n,
    max_e_n,
    1 - n_outside / nullif(n_e_n, 0) AS within_ratio,
    CASE
        WHEN max_e_n > 2 OR (n_outside > 0 AND binomial_tail(n_outside, n_e_n, 0.05) < 0.05 + 1e-9) THEN 'disagrees'
        WHEN n < 2 THEN 'too few'
        WHEN abs(bias_um) > half_um THEN 'biased'
        WHEN n_e_n = 0 THEN 'unbiased'
        ELSE 'agrees'
    END AS verdict,
    paper_error_um,
    paper_error_um / nullif(max_error_um, 0) AS paper_ratio
FROM intervals
LEFT JOIN paper USING (quantity)
ORDER BY quantity_order(quantity), quantity, side
