"""Figures of statistical control: individuals charts of days with their EWMA and signals; means of parts and factors."""

from __future__ import annotations

import numpy as np

from warehouse.render_panels import (
    BAND,
    FAINT,
    MEAN,
    POINT,
    REVIEW,
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

MOST_CHARTS = 24


def control(rows: dict[str, list[Row]], salt: str) -> Drawing:
    """Day means with control limits, EWMA with its limits, temperature below; days with a signal are ringed."""
    from matplotlib.figure import Figure

    limits = by(rows["control_limits"], "wheelset_id", "quantity", "side")
    charts = list(by(rows["control"], "wheelset_id", "quantity", "side").items())
    panels: dict[str, list[Panel]] = {}
    for index, (key, days) in enumerate(charts[:MOST_CHARTS]):
        limit = limits[key][0]
        figure = Figure(figsize=(4.4, 3.7), layout="constrained")
        axes, below = figure.subplots(2, sharex=True, height_ratios=(2.6, 1))
        times = [row["acquired_on"] for row in days]
        center = limit["center_mm"]
        axes.axhspan(
            1000 * (limit["ewma_lower_limit_mm"] - center),
            1000 * (limit["ewma_upper_limit_mm"] - center),
            color=BAND,
            linewidth=0,
        )
        axes.axhline(0, color=FAINT)
        for end in ("lower_limit_mm", "upper_limit_mm"):
            axes.axhline(1000 * (limit[end] - center), color=REVIEW, linestyle=(0, (5, 3)))
        means = 1000 * (column(days, "mean_mm") - center)
        axes.plot(times, means, "o", color=POINT, markersize=3.4)
        axes.plot(times, 1000 * (column(days, "ewma_mm") - center), color=MEAN)
        signals = [row["n_signals"] > 0 for row in days]
        axes.plot(
            [t for t, s in zip(times, signals, strict=True) if s],
            means[np.array(signals, dtype=bool)],
            "s",
            markerfacecolor="none",
            color=REVIEW,
            markersize=7,
        )
        axes.set_ylabel("from centre (µm)")
        below.plot(times, column(days, "mean_wheelset_temperature_c"), "-", color=FAINT)
        below.set_ylabel("°C")
        below.locator_params(axis="y", nbins=3)
        dates(below)
        title = title_of(key[1], key[2])
        picture = Panel(title, f"Control chart of {title}, {len(days)} days", svg(figure, f"{salt}-{index}"))
        panels.setdefault(f"Wheelset {key[0]}", []).append(picture)
    left_out = len(charts) - min(len(charts), MOST_CHARTS)
    note = f"{left_out} more series are in the tables." if left_out else ""
    return Drawing(tuple(Group(head, tuple(shown)) for head, shown in panels.items()), note)


def cells(rows: dict[str, list[Row]], salt: str) -> Drawing:
    """Mean of each part at each level of the factor, as deviation from the part's mean: lines that lie apart are bias."""
    panels = []
    for index, (key, found) in enumerate(by(rows["cells"], "quantity", "side").items()):
        figure, axes = axes_of()
        parts = list(dict.fromkeys(row["part"] for row in found))
        places = {part: place for place, part in enumerate(parts)}
        for level in by(found, "factor").values():
            axes.plot(
                [places[row["part"]] for row in level], column(level, "deviation_um"), "-", color=FAINT, linewidth=0.7
            )
        axes.errorbar(
            [places[row["part"]] for row in found],
            column(found, "deviation_um"),
            yerr=np.nan_to_num(column(found, "standard_error_um")),
            fmt="o",
            color=POINT,
            markersize=3,
            elinewidth=0.6,
            alpha=0.8,
        )
        axes.axhline(0, color=REVIEW)
        axes.set_xticks(range(len(parts)), [str(place + 1) for place in range(len(parts))])
        axes.set_xlabel("part, in the order of the table")
        axes.set_ylabel("from part's mean (µm)")
        title = title_of(*key)
        panels.append(Panel(title, f"Means of {title} by part and factor", svg(figure, f"{salt}-{index}")))
    return Drawing((Group("", tuple(panels)),) if panels else ())
