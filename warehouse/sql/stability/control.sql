-- Is each series in statistical control? Day by day on the individuals chart with Nelson's eight rules, the moving range,
-- the mean-and-s chart, and the exponentially weighted mean (lambda 0.2), which sees a slow drift first.
-- Rules: 1 beyond 3 sigma; 2 nine in a row on one side; 3 six in a row rising or falling; 4 fourteen alternating; 5 two of
-- three beyond 2 sigma on one side; 6 four of five beyond 1 sigma on one side; 7 fifteen within 1 sigma; 8 eight beyond 1
-- sigma. Signals stand at the day that completes the pattern.
--
-- Columns
-- wheelset_id: wheelset
-- quantity: measured quantity
-- side: left, right or both
-- acquired_on: day
-- n: values of the day
-- mean_mm: mean of the day, the individual value
-- sigmas: distance from the centre, in sigmas of the individuals chart
-- moving_range_um: change from the day before, in µm
-- standard_deviation_um: standard deviation within the day, in µm
-- ewma_mm: exponentially weighted mean up to this day
-- mean_wheelset_temperature_c: mean wheelset temperature, °C
-- rules: Nelson's rules that are broken
-- signals: every signal in words: rules, moving range, mean against the scatter within days, s, EWMA
-- n_signals: number of signals
WITH standard AS (
    SELECT
        days.*,
        chart.center_mm,
        chart.sigma_between_um,
        chart.sigma_within_um,
        chart.moving_range_limit_um,
        1000 * (days.mean_mm - chart.center_mm) / nullif(chart.sigma_between_um, 0) AS z,
        1000 * (days.mean_mm - lag(days.mean_mm) OVER course) AS step_um,
        row_number() OVER course AS i
    FROM stability_days AS days
    INNER JOIN stability_control_limits AS chart USING (wheelset_id, quantity, side)
    WINDOW course AS (PARTITION BY wheelset_id, quantity, side ORDER BY acquired_on)
),

turned AS (
    SELECT
        *,
        step_um * lag(step_um) OVER course < 0 AS alternates,
        CASE
            WHEN i < 3000
                THEN pow(0.8, i) * (
                    sum(0.2 * (mean_mm - center_mm) * pow(0.8, -i)) OVER (course ROWS UNBOUNDED PRECEDING)
                )
        END AS ewma_deviation_mm
    FROM standard
    WINDOW course AS (PARTITION BY wheelset_id, quantity, side ORDER BY acquired_on)
),

counted AS (
    SELECT
        *,
        abs(z) > 3 AS rule_1,
        count(*) FILTER (WHERE z > 0) OVER nine = 9 OR count(*) FILTER (WHERE z < 0) OVER nine = 9 AS rule_2,
        count(*) FILTER (WHERE step_um > 0) OVER five = 5 OR count(*) FILTER (WHERE step_um < 0) OVER five = 5 AS rule_3,
        count(*) FILTER (WHERE alternates) OVER twelve = 12 AS rule_4,
        (z > 2 AND count(*) FILTER (WHERE z > 2) OVER three >= 2)
        OR (z < -2 AND count(*) FILTER (WHERE z < -2) OVER three >= 2) AS rule_5,
        (z > 1 AND count(*) FILTER (WHERE z > 1) OVER five >= 4)
        OR (z < -1 AND count(*) FILTER (WHERE z < -1) OVER five >= 4) AS rule_6,
        count(*) FILTER (WHERE abs(z) < 1) OVER fifteen = 15 AS rule_7,
        count(*) FILTER (WHERE abs(z) > 1) OVER eight = 8 AS rule_8,
        abs(step_um) > moving_range_limit_um AS range_signal,
        sigma_within_um > 0 AND 1000 * abs(mean_mm - center_mm) > 3 * sigma_within_um / sqrt(n) AS mean_signal,
        n > 1 AND standard_deviation_um > sigma_within_um * (1 + 3 / sqrt(2.0 * (n - 1))) AS s_signal,
        abs(ewma_deviation_mm) > 3 * sigma_between_um / 1000 * sqrt(0.2 / 1.8 * (1 - pow(0.8, 2 * i))) AS ewma_signal
    FROM turned
    WINDOW
        three AS (PARTITION BY wheelset_id, quantity, side ORDER BY acquired_on ROWS 2 PRECEDING),
        five AS (PARTITION BY wheelset_id, quantity, side ORDER BY acquired_on ROWS 4 PRECEDING),
        eight AS (PARTITION BY wheelset_id, quantity, side ORDER BY acquired_on ROWS 7 PRECEDING),
        nine AS (PARTITION BY wheelset_id, quantity, side ORDER BY acquired_on ROWS 8 PRECEDING),
        twelve AS (PARTITION BY wheelset_id, quantity, side ORDER BY acquired_on ROWS 11 PRECEDING),
        fifteen AS (PARTITION BY wheelset_id, quantity, side ORDER BY acquired_on ROWS 14 PRECEDING)
),

listed AS (
    SELECT
        *,
        list_filter(
            [
                CASE WHEN rule_1 THEN 1 END, CASE WHEN rule_2 THEN 2 END, CASE WHEN rule_3 THEN 3 END,
                CASE WHEN rule_4 THEN 4 END, CASE WHEN rule_5 THEN 5 END, CASE WHEN rule_6 THEN 6 END,
                CASE WHEN rule_7 THEN 7 END, CASE WHEN rule_8 THEN 8 END
            ],
            lambda rule: rule IS NOT NULL
        ) AS rules,
        list_filter(
            [
                CASE WHEN range_signal THEN 'moving range' END,
                CASE WHEN mean_signal THEN 'mean against scatter within days' END,
                CASE WHEN s_signal THEN 's' END,
                CASE WHEN ewma_signal THEN 'EWMA' END
            ],
            lambda word: word IS NOT NULL
        ) AS others
    FROM counted
)

SELECT
    wheelset_id,
    quantity,
    side,
    acquired_on,
    n,
    mean_mm,
    z AS sigmas,
    abs(step_um) AS moving_range_um,
    standard_deviation_um,
    center_mm + ewma_deviation_mm AS ewma_mm,
    mean_wheelset_temperature_c,
    array_to_string(rules, ', ') AS rules,
    array_to_string(list_concat(list_transform(rules, lambda rule: 'rule ' || rule), others), ', ') AS signals,
    len(rules) + len(others) AS n_signals
FROM listed
ORDER BY wheelset_id, quantity_order(quantity), side, acquired_on
