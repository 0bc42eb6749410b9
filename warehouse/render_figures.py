"""Drawing a report's figures as SVG: small panels, one for each quantity and side, from the report's tables.

No number is made here, and no text that comes from data is drawn: names stand beside the picture, where they are
escaped. The same tables give the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from warehouse import render_figures_calibration as calibration
from warehouse import render_figures_control as control
from warehouse import render_figures_service as service
from warehouse.render_panels import (
    BAND,
    FAINT,
    MANY,
    MEAN,
    POINT,
    REVIEW,
    STYLE,
    Drawing,
    Group,
    Panel,
    Row,
    axes_of,
    by,
    column,
    dates,
    svg,
    title_of,
)

if TYPE_CHECKING:
    from warehouse.report import Report
    from warehouse.report_declare import FigureSpec


def draw(report: Report, figure: FigureSpec) -> Drawing:
    """The panels of one figure; none where its tables are empty."""
    import matplotlib

    rows = {
        name: report.blocks[name].table.select(columns).to_pylist() for name, columns in NEEDED[figure.kind].items()
    }

    salt = f"{report.spec.name}-{figure.name}"
    style: Any = STYLE | {"svg.hashsalt": salt}
    with matplotlib.rc_context(style):
        return PAINTERS[figure.kind](rows, salt)


def _errors_over_time(rows: dict[str, list[Row]], salt: str) -> Drawing:
    panels = []
    summary = by(rows["summary"], "quantity", "side")
    for index, (key, pairs) in enumerate(by(rows["pairs"], "quantity", "side").items()):
        figure, axes = axes_of()
        dated = all(row["captured_at"] is not None for row in pairs)
        x = [row["captured_at"] for row in pairs] if dated else list(range(1, len(pairs) + 1))
        expanded = 2 * (summary[key][0]["u_reference_um"] or 0)
        axes.axhspan(-expanded, expanded, color=BAND, linewidth=0)
        axes.axhline(0, color=REVIEW)
        axes.axhline(summary[key][0]["bias_um"], color=MEAN, linestyle=(0, (5, 3)))
        bars = np.nan_to_num(column(pairs, "expanded_uncertainty_mm", 1000))
        many = len(pairs) > MANY
        axes.errorbar(
            x,
            column(pairs, "error_um"),
            yerr=bars,
            fmt="o",
            markersize=2.4 if many else 3.6,
            color=POINT,
            ecolor=POINT,
            elinewidth=0.6,
            alpha=0.35 if many else 0.8,
            rasterized=many,
        )
        axes.set_ylabel("error (µm)")
        dates(axes) if dated else axes.set_xlabel("pair, in the order of the file")
        title = title_of(*key)
        alt = f"Errors of {title}, {len(pairs)} values, with the bias and the review's uncertainty"
        panels.append(Panel(title, alt, svg(figure, f"{salt}-{index}")))
    return Drawing((Group("", tuple(panels)),) if panels else ())


def _bland_altman(rows: dict[str, list[Row]], salt: str) -> Drawing:
    panels = []
    summary, limits = (by(rows[name], "quantity", "side") for name in ("summary", "limits"))
    for index, (key, pairs) in enumerate(by(rows["pairs"], "quantity", "side").items()):
        figure, axes = axes_of()
        limit = limits[key][0]
        for end in ("lower", "upper"):
            if limit[f"{end}_limit_um"] is not None:
                axes.axhspan(limit[f"{end}_limit_low_um"], limit[f"{end}_limit_high_um"], color=BAND, linewidth=0)
                axes.axhline(limit[f"{end}_limit_um"], color=MEAN, linestyle=(0, (1, 2)))
        axes.axhline(0, color=REVIEW)
        axes.axhline(summary[key][0]["bias_um"], color=MEAN, linestyle=(0, (5, 3)))
        many = len(pairs) > MANY
        axes.plot(
            column(pairs, "mean_mm"),
            column(pairs, "error_um"),
            "o",
            markersize=2.4 if many else 3.6,
            color=POINT,
            alpha=0.5 if many else 0.8,
            rasterized=many,
        )
        axes.ticklabel_format(axis="x", useOffset=False, style="plain")
        axes.locator_params(axis="x", nbins=4)
        axes.set_xlabel("mean of machine and review (mm)")
        axes.set_ylabel("difference (µm)")
        title = title_of(*key)
        alt = f"Differences of {title} over size, {len(pairs)} values, with limits of agreement"
        panels.append(Panel(title, alt, svg(figure, f"{salt}-{index}")))
    return Drawing((Group("", tuple(panels)),) if panels else ())


def _six_dimensions(rows: dict[str, list[Row]], salt: str) -> Drawing:
    wheelsets = by(rows["plotted"], "wheelset_id")
    reviews = by(rows["reviews"], "wheelset_id", "quantity", "side")
    months = by(rows["by_month"], "wheelset_id", "quantity", "side")
    groups = []
    for number, wheelset in enumerate(sorted(wheelsets)):
        panels = []
        for index, (key, values) in enumerate(by(wheelsets[wheelset], "quantity", "side").items()):
            whole = (*wheelset, *key)
            drawn = _course(values, months[whole], reviews.get(whole, []), f"{salt}-{number}-{index}")
            title = title_of(*key)
            panels.append(Panel(title, f"Values of {title} over time, {values[0]['n']} scans", drawn))
        groups.append(Group(f"Wheelset {wheelset[0]}", tuple(panels)))
    left_out = len(by(rows["over_all"], "wheelset_id")) - len(groups)
    note = (
        f"Drawn are the {len(groups)} wheelsets with most values; {left_out} more are in the tables."
        if left_out
        else ""
    )
    return Drawing(tuple(groups), note)


def _course(values: list[Row], months: list[Row], reviews: list[Row], salt: str) -> str:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.4, 3.7), layout="constrained")
    axes, below = figure.subplots(2, sharex=True, height_ratios=(2, 1))
    for review in reviews:
        line, half = review["review_mm"], review["expanded_uncertainty_mm"] or 0
        axes.axhspan(line - half, line + half, color=BAND, linewidth=0)
        axes.axhline(line, color=REVIEW)
    times = [row["captured_at"] for row in values]
    many = len(values) > MANY
    size = 2.4 if many else 3.6
    below.plot(
        times, column(values, "value_uncompensated_mm"), "x", markersize=size, color=FAINT, alpha=0.6, rasterized=many
    )
    for each in (axes, below):
        each.plot(times, column(values, "value_mm"), "o", markersize=size, color=POINT, alpha=0.7, rasterized=many)
    axes.plot(
        [row["mean_captured_at"] for row in months],
        column(months, "mean_mm"),
        "-D",
        color=MEAN,
        markersize=4,
        markerfacecolor="white",
    )
    for each, ticks in ((axes, 6), (below, 3)):
        each.yaxis.set_major_formatter("{x:.4f}")
        each.locator_params(axis="y", nbins=ticks)
        each.set_ylabel("mm")
    dates(below)
    return svg(figure, salt)


NEEDED: dict[str, dict[str, list[str]]] = {
    "errors_over_time": {
        "pairs": ["quantity", "side", "captured_at", "error_um", "expanded_uncertainty_mm"],
        "summary": ["quantity", "side", "bias_um", "u_reference_um"],
    },
    "bland_altman": {
        "pairs": ["quantity", "side", "mean_mm", "error_um"],
        "summary": ["quantity", "side", "bias_um"],
        "limits": [
            "quantity",
            "side",
            "lower_limit_um",
            "lower_limit_low_um",
            "lower_limit_high_um",
            "upper_limit_um",
            "upper_limit_low_um",
            "upper_limit_high_um",
        ],
    },
    "six_dimensions": {
        "plotted": ["wheelset_id", "quantity", "side", "captured_at", "value_mm", "value_uncompensated_mm", "n"],
        "reviews": ["wheelset_id", "quantity", "side", "review_mm", "expanded_uncertainty_mm"],
        "by_month": ["wheelset_id", "quantity", "side", "mean_captured_at", "mean_mm"],
        "over_all": ["wheelset_id"],
    },
    "control": {
        "control": [
            "wheelset_id",
            "quantity",
            "side",
            "acquired_on",
            "mean_mm",
            "ewma_mm",
            "n_signals",
            "mean_wheelset_temperature_c",
        ],
        "control_limits": [
            "wheelset_id",
            "quantity",
            "side",
            "center_mm",
            "lower_limit_mm",
            "upper_limit_mm",
            "ewma_lower_limit_mm",
            "ewma_upper_limit_mm",
        ],
    },
    "cells": {"cells": ["quantity", "side", "part", "factor", "deviation_um", "standard_error_um"]},
    "wear": {
        "courses": [
            "place",
            "wheelset_id",
            "quantity",
            "side",
            "captured_at",
            "value",
            "expanded_uncertainty",
            "unit",
            "limit_value",
        ],
        "bands": ["place", "day_at", "value", "value_low", "value_high"],
    },
    "history": {
        "history": [
            "wheelset_id",
            "quantity",
            "side",
            "captured_at",
            "value",
            "expanded_uncertainty",
            "unit",
            "limit_min",
            "limit_max",
        ]
    },
    "residuals": {
        "residuals": [
            "calibration_id",
            "sensor_id",
            "camera",
            "u_px",
            "v_px",
            "residual_u_px",
            "residual_v_px",
            "image_width_px",
            "image_height_px",
        ],
        "board_poses": ["calibration_id", "sensor_id", "tilt_deg", "distance_mm"],
        "sensors": ["calibration_id", "sensor_id", "nearest_mm", "farthest_mm"],
    },
    "profile": {"profile": ["side", "lateral_mm", "height_mm", "deviation_um"]},
    "map": {"map": ["side", "angle_deg", "lateral_mm", "deviation_um"]},
    "polar": {"turns": ["series", "side", "angle_deg", "deviation_um", "roundness_um", "used"]},
}
PAINTERS: dict[str, Callable[[dict[str, list[Row]], str], Drawing]] = {
    "errors_over_time": _errors_over_time,
    "bland_altman": _bland_altman,
    "six_dimensions": _six_dimensions,
    "control": control.control,
    "cells": control.cells,
    "wear": service.wear,
    "history": service.history,
    "polar": service.polar,
    "profile": service.profile,
    "map": service.deviation_map,
    "residuals": calibration.residuals,
}
