"""What the accuracy report is made of, for a warehouse and for pairs from a file. `sql/accuracy` makes its numbers."""

from __future__ import annotations

from dataclasses import replace

from warehouse.report_declare import (
    PRODUCTION_VALUES,
    REFUSED_SCANS,
    VALUES_NOT_GIVEN,
    BlockSpec,
    FigureSpec,
    ReportSpec,
)

_SUMMARY = BlockSpec(
    name="summary",
    sql="accuracy/summary.sql",
    title="Errors by quantity",
    says=(
        "Verdict: disagrees if an |E_n| exceeds 2, or if more of them exceed 1 than one in twenty explains (binomial "
        "probability at most 5 %); else too few if there is one pair only; else biased if the interval of the bias "
        "leaves out zero; else agrees, or unbiased where no uncertainty was stated. A review's U is taken as k = 2. "
        "The paper's figure is the largest error in its Table 1, where one wheelset was measured six times and most "
        "of the scatter is the review's."
    ),
    empty="No pair of a measured value and a review.",
    shown=(
        "quantity",
        "side",
        "n",
        "n_wheelsets",
        "n_reviews",
        "bias_um",
        "bias_low_um",
        "bias_high_um",
        "standard_deviation_um",
        "max_error_um",
        "mean_expanded_uncertainty_um",
        "mean_e_n",
        "within_ratio",
        "verdict",
        "paper_error_um",
        "paper_ratio",
    ),
)
_LIMITS = BlockSpec(
    name="limits",
    sql="accuracy/limits.sql",
    title="Limits of agreement",
    says="Lower and upper limit: mean error ± 1.96 s; each has a 95 % interval of its own, ± t s √(3/n).",
    empty="No pair of a measured value and a review.",
)
_PAIRS = BlockSpec(
    name="pairs",
    sql="accuracy/pairs.sql",
    title="Pairs of value and review",
    empty="No pair of a measured value and a review.",
    shown=(
        "scan_id",
        "quantity",
        "side",
        "measured_mm",
        "expanded_uncertainty_mm",
        "reference_mm",
        "reference_expanded_uncertainty_mm",
        "days_to_reference",
        "error_um",
        "e_n",
    ),
    n_keys=3,
)
_ERROR_FIGURES = (
    FigureSpec(
        name="errors",
        kind="errors_over_time",
        title="Errors over time",
        says="Error of each value with its expanded uncertainty, in µm; around zero, the review's.",
        legend=(
            ("point", "measured minus reference, with U"),
            ("line", "no error"),
            ("band", "the review's U"),
            ("dashed", "bias"),
        ),
        after="summary",
    ),
    FigureSpec(
        name="agreement",
        kind="bland_altman",
        title="Difference against size",
        says=(
            "Bland and Altman's plot: each difference over the mean of machine and review. Repeats of one wheelset lie "
            "on a slanting line, since one review stands for them all."
        ),
        legend=(
            ("point", "measured minus reference"),
            ("line", "no difference"),
            ("dashed", "bias"),
            ("dotted", "limits of agreement"),
            ("band", "their 95 % intervals"),
        ),
        after="limits",
    ),
)

ACCURACY = ReportSpec(
    name="accuracy",
    title="Accuracy against independent reviews",
    about=(
        "Error is measured minus reference, both at 20 °C. Only production scans count; reference scans and "
        "certificates never enter."
    ),
    main="pairs",
    order=("summary", "limits", "by_wheelset", "pairs", "unreviewed", "not_given", "refused"),
    nothing="There is no production measurement with a review yet: nothing can be said about accuracy.",
    steps=(PRODUCTION_VALUES,),
    blocks=(
        _PAIRS,
        _SUMMARY,
        _LIMITS,
        BlockSpec(
            name="by_wheelset",
            sql="accuracy/by_wheelset.sql",
            title="Errors by wheelset",
            empty="No pair of a measured value and a review.",
            shown=(
                "wheelset_id",
                "quantity",
                "side",
                "n",
                "n_reviews",
                "mean_measured_mm",
                "mean_reference_mm",
                "bias_um",
                "standard_deviation_um",
                "max_error_um",
                "mean_e_n",
                "max_e_n",
                "farthest_days",
            ),
            n_keys=3,
            limit=120,
        ),
        BlockSpec(
            name="unreviewed",
            sql="accuracy/unreviewed.sql",
            title="Values without a review",
            empty="Every measured value has a review.",
            n_keys=1,
        ),
        VALUES_NOT_GIVEN,
        REFUSED_SCANS,
    ),
    figures=_ERROR_FIGURES,
)

ACCURACY_OF_PAIRS = ReportSpec(
    name="accuracy",
    title="Accuracy of values from elsewhere",
    about="Error is measured minus reference, as the file states them.",
    main="pairs",
    order=("summary", "limits", "pairs"),
    nothing="The file holds no pair: nothing can be said about accuracy.",
    blocks=(
        BlockSpec(
            name="pairs",
            sql="accuracy/pairs_from_file.sql",
            title="Pairs of value and reference",
            empty="The file holds no pair.",
            shown=tuple(name for name in _PAIRS.shown if name != "days_to_reference"),
            n_keys=3,
        ),
        _SUMMARY,
        _LIMITS,
    ),
    figures=(replace(_ERROR_FIGURES[0], title="Errors in the order of the file"), _ERROR_FIGURES[1]),
)
