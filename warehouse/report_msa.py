"""What the measurement system analysis is made of. `sql/msa` makes its numbers; `wheelset tool msa` does any CSV."""

from __future__ import annotations

from warehouse.report_declare import PRODUCTION_VALUES, BlockSpec, FigureSpec, ReportSpec

MSA = ReportSpec(
    name="msa",
    title="Measurement system analysis",
    about=(
        "Repeatability and reproducibility of the rig's production values (ISO 5725), gauge R&R against parts and "
        "tolerances, and linearity. Wheelsets are the parts, days the factor. Only production scans count."
    ),
    main="precision",
    order=("precision", "gauge", "linearity", "cells", "readings"),
    nothing="No wheelset was measured on two days, with two readings on one of them: nothing can be said of the gauge.",
    steps=(PRODUCTION_VALUES,),
    blocks=(
        BlockSpec(name="readings", sql="msa/readings.sql", title="Readings", empty="No reading.", n_keys=4, limit=12),
        BlockSpec(name="cells", sql="msa/cells.sql", title="Days of the wheelsets", empty="No reading.", n_keys=4),
        BlockSpec(
            name="precision",
            sql="msa/precision.sql",
            title="Repeatability and reproducibility",
            empty="No wheelset was measured on two days, with two readings on one of them.",
            shown=(
                "quantity",
                "side",
                "n_parts",
                "n_days",
                "n",
                "repeatability_um",
                "between_days_um",
                "reproducibility_um",
                "repeatability_limit_um",
                "reproducibility_limit_um",
                "stated_um",
                "reproducibility_share",
            ),
        ),
        BlockSpec(
            name="gauge",
            sql="msa/gauge.sql",
            title="Gauge against parts and tolerances",
            says="For a full study with operators, write a CSV and use `wheelset tool msa`, which gives the ANOVA table.",
            empty="Fewer than two wheelsets were measured on two days.",
        ),
        BlockSpec(
            name="linearity",
            sql="msa/linearity.sql",
            title="Linearity",
            empty="No quantity was reviewed at sizes that differ by 1 mm or more.",
        ),
    ),
    figures=(
        FigureSpec(
            name="cells",
            kind="cells",
            title="Days of the wheelsets",
            says="Mean of each day, from the mean of its wheelset, with its standard error; lines join a day.",
            legend=(("point", "mean of a day"), ("grey", "the same day"), ("line", "mean of the wheelset")),
            after="precision",
        ),
    ),
)
