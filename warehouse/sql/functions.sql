-- Functions that the reports' queries use and SQL lacks. They are plain SQL, so that a query copied from a report runs
-- in any DuckDB client that has executed this file. The tests hold each of them against scipy.

-- Quantile of Student's t that leaves 2.5 % on either side, for whole degrees of freedom: a table up to 30, from there
-- the expansion in powers of 1/df about the normal quantile (error below 1e-7).
CREATE OR REPLACE MACRO student_t_95(df) AS CASE
    WHEN df < 1 THEN NULL
    WHEN df < 31 THEN list_extract([
        12.706204736, 4.302652730, 3.182446305, 2.776445105, 2.570581836, 2.446911851, 2.364624252, 2.306004135,
        2.262157163, 2.228138852, 2.200985160, 2.178812830, 2.160368656, 2.144786688, 2.131449546, 2.119905299,
        2.109815578, 2.100922040, 2.093024054, 2.085963447, 2.079613845, 2.073873068, 2.068657610, 2.063898562,
        2.059538553, 2.055529439, 2.051830516, 2.048407142, 2.045229642, 2.042272456
    ]::DOUBLE[], floor(df)::BIGINT)
    ELSE 1.959963984540054 + 2.372271230 / df + 2.822498616 / df ** 2 + 2.555849680 / df ** 3 + 1.589534054 / df ** 4
END;

-- Two-sided p-value of Student's t for whole degrees of freedom, by the finite trigonometric series for even and odd
-- df in the angle atan(t / sqrt(df)). Absolute error below 1e-9.
CREATE OR REPLACE MACRO student_t_p(t, df) AS CASE
    WHEN df < 1 OR t IS NULL OR isnan(t) THEN NULL
    WHEN df % 2 = 0 THEN greatest(0.0, 1.0 - sin(atan(abs(t) / sqrt(df))) * list_sum(list_transform(
        range((df // 2)::BIGINT),
        lambda j: exp(
            lgamma(2 * j + 1.0) - 2 * lgamma(j + 1.0) - 2 * j * ln(2.0) + 2 * j * ln(cos(atan(abs(t) / sqrt(df))))
        )
    )))
    ELSE greatest(0.0, 1.0 - 2.0 / pi() * (
        atan(abs(t) / sqrt(df))
        + sin(atan(abs(t) / sqrt(df))) * coalesce(list_sum(list_transform(
            range((df // 2)::BIGINT),
            lambda j: exp(
                2 * j * ln(2.0) + 2 * lgamma(j + 1.0) - lgamma(2 * j + 2.0)
                + (2 * j + 1) * ln(cos(atan(abs(t) / sqrt(df))))
            )
        )), 0.0)
    ))
END;

-- Probability of k or more hits among n, each of probability p.
CREATE OR REPLACE MACRO binomial_tail(k, n, p) AS CASE
    WHEN k <= 0 THEN 1.0
    ELSE least(1.0, list_sum(list_transform(
        range(k::BIGINT, n::BIGINT + 1),
        lambda i: exp(
            lgamma(n + 1.0) - lgamma(i + 1.0) - lgamma(n - i + 1.0) + i * ln(p) + (n - i) * ln(1.0 - p)
        )
    )))
END;

-- Order in which quantities are listed: the paper's first, the rest after them.
CREATE OR REPLACE MACRO quantity_order(quantity) AS coalesce(list_position([
    'journal_diameter', 'wheel_diameter', 'shoulder_distance', 'inner_distance', 'flange_height', 'flange_thickness',
    'qr', 'radial_runout', 'axial_runout'
], quantity), 99);

-- Area of the standard normal distribution beyond x >= 0.
CREATE OR REPLACE MACRO normal_tail(x) AS CASE
    WHEN x < 7.07106781186547 THEN exp(-x * x / 2) * (
        (((((3.52624965998911e-2 * x + 0.700383064443688) * x + 6.37396220353165) * x + 33.912866078383) * x
            + 112.079291497871) * x + 221.213596169931) * x + 220.206867912376
    ) / (
        ((((((8.83883476483184e-2 * x + 1.75566716318264) * x + 16.064177579207) * x + 86.7807322029461) * x
            + 296.564248779674) * x + 637.333633378831) * x + 793.826512519948) * x + 440.413735824752
    )
    ELSE exp(-x * x / 2) / (x + 1 / (x + 2 / (x + 3 / (x + 4 / (x + 0.65))))) / 2.506628274631
END;

-- Standard normal distribution function: a quotient of polynomials in |x| up to 7.07 (Hart 1968, function 5666, error
-- below 1e-14), beyond it the first terms of the continued fraction.
CREATE OR REPLACE MACRO normal_cdf(x) AS CASE
    WHEN x IS NULL OR isnan(x) THEN NULL
    WHEN x > 38 THEN 1.0
    WHEN x < -38 THEN 0.0
    WHEN x <= 0 THEN normal_tail(-x)
    ELSE 1.0 - normal_tail(x)
END;

-- Probability that Student's t lies above t, for whole degrees of freedom; beyond 1000 of them the normal's.
CREATE OR REPLACE MACRO student_t_tail(t, df) AS CASE
    WHEN df > 1000 THEN normal_cdf(-t)
    WHEN t >= 0 THEN student_t_p(t, df) / 2.0
    ELSE 1.0 - student_t_p(t, df) / 2.0
END;

-- Order of the levels of limits, the gravest first.
CREATE OR REPLACE MACRO level_order(level) AS coalesce(list_position(['operating', 'planning', 'after_turning'], level), 9);
