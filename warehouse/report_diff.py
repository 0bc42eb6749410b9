"""Two versions of code or configuration over the same scans: which values changed. `sql/diff` makes its numbers."""

from __future__ import annotations

from warehouse.report_declare import BlockSpec, ReportSpec

DIFF = ReportSpec(
    name="diff",
    title="What changed between two versions",
    about="The same scans, measured by version A and by version B; superseded values are kept and compared here.",
    main="values",
    order=("summary", "values", "versions"),
    nothing="No scan has values of both versions.",
    blocks=(
        BlockSpec(
            name="versions",
            sql="diff/versions.sql",
            title="Versions in this warehouse",
            empty="No value yet.",
            n_keys=2,
        ),
        BlockSpec(
            name="values",
            sql="diff/values.sql",
            title="Values, the largest changes first",
            empty="No scan has values of both versions.",
            shown=(
                "scan_id",
                "quantity",
                "side",
                "old_value",
                "new_value",
                "change",
                "expanded_uncertainty",
                "unit",
                "change_ratio",
                "what",
            ),
            n_keys=3,
            limit=40,
        ),
        BlockSpec(name="summary", sql="diff/summary.sql", title="By quantity", empty="No value."),
    ),
)
