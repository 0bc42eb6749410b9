"""Figures of the fleet and wheelset pages: where wear leads, the history of a wheelset, polar plots of its turns."""

from __future__ import annotations

from typing import TYPE_CHECKING

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

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

SERIES = {
    "tread_radius": "Run-out and roundness of the tread",
    "face_lateral": "Run-out of the inner face",
    "journal_radius": "Run-out and roundness of the journal",
    "shoulder_lateral": "Run-out of the shoulder",
}


def wear(rows: dict[str, list[Row]], salt: str) -> Drawing:
    """Visits with U, the trend with its interval, and the limit, for each wheelset of the list."""
    panels = []
    bands = by(rows["bands"], "place")
    for index, (key, visits) in enumerate(by(rows["courses"], "place").items()):
        figure, axes = axes_of()
        band = bands.get(key, [])
        times = [row["day_at"] for row in band]
        if band:
            axes.fill_between(times, column(band, "value_low"), column(band, "value_high"), color=BAND, linewidth=0)
            axes.plot(times, column(band, "value"), color=MEAN)
        axes.errorbar(
            [row["captured_at"] for row in visits],
            column(visits, "value"),
            yerr=column(visits, "expanded_uncertainty"),
            fmt="o",
            markersize=3.6,
            color=POINT,
            elinewidth=0.8,
        )
        first = visits[0]
        _limits(axes, visits, [first["limit_value"]])
        axes.set_ylabel(first["unit"] if first["unit"] in ("mm", "deg") else "")
        _plain(axes)
        dates(axes)
        title = f"{first['wheelset_id']}: {title_of(first['quantity'], first['side'])}"
        panels.append(Panel(title, f"{title}: {len(visits)} visits, trend and limit", svg(figure, f"{salt}-{index}")))
    return Drawing((Group("", tuple(panels)),) if panels else ())


def history(rows: dict[str, list[Row]], salt: str) -> Drawing:
    """Every quantity of one wheelset over its visits, with the operating limits where they are near."""
    panels = []
    for index, (key, visits) in enumerate(by(rows["history"], "wheelset_id", "quantity", "side").items()):
        figure, axes = axes_of()
        times = [row["captured_at"] for row in visits]
        values, half = column(visits, "value"), column(visits, "expanded_uncertainty")
        axes.errorbar(times, values, yerr=half, fmt="o-", markersize=3.6, color=POINT, elinewidth=0.8, linewidth=0.8)
        _limits(axes, visits, [visits[0]["limit_min"], visits[0]["limit_max"]])
        axes.set_ylabel(visits[0]["unit"] if visits[0]["unit"] in ("mm", "deg") else "")
        _plain(axes)
        dates(axes)
        title = title_of(key[1], key[2])
        panels.append(Panel(title, f"{title} over {len(visits)} visits", svg(figure, f"{salt}-{index}")))
    return Drawing((Group("", tuple(panels)),) if panels else ())


def _limits(axes: object, visits: list[Row], limits: list[float | None]) -> None:
    """A limit is drawn where it does not squeeze the course into a line: within fifty times what the course spans."""
    values, half = column(visits, "value"), column(visits, "expanded_uncertainty")
    low, high = np.nanmin(values - half), np.nanmax(values + half)
    for limit in limits:
        if limit is not None and max(low - limit, limit - high, 0) <= 50 * max(high - low, 1e-9):
            axes.axhline(limit, color=REVIEW, linewidth=1.6)  # type: ignore[attr-defined]


def _plain(axes: object) -> None:
    axes.ticklabel_format(axis="y", useOffset=False, style="plain")  # type: ignore[attr-defined]
    axes.locator_params(axis="y", nbins=6)  # type: ignore[attr-defined]


def polar(rows: dict[str, list[Row]], salt: str) -> Drawing:
    """Deviation over the turn in µm, magnified about a circle: run-out (grey) and roundness (blue)."""
    panels = []
    for index, (key, frames) in enumerate(by(rows["turns"], "series", "side").items()):
        used = [row for row in frames if row["used"]]
        if len(used) < 4:
            continue
        figure, axes = _polar_axes()
        angle = np.radians(column(used, "angle_deg"))
        closed = np.append(angle, angle[0] + 2 * np.pi)
        names = ["deviation_um"] if key[0].endswith("lateral") else ["deviation_um", "roundness_um"]
        reach = max(float(np.nanmax(np.abs(column(used, name)))) for name in names) or 1.0
        for name in names:
            values = column(used, name)
            colour = POINT if name == names[-1] else FAINT
            axes.plot(closed, np.append(values, values[0]), color=colour, linewidth=1.1)
        axes.plot(np.linspace(0, 2 * np.pi, 181), np.zeros(181), color=MEAN, linewidth=0.7, linestyle=(0, (5, 3)))
        left_out = [row for row in frames if not row["used"]]
        if left_out:
            shown = np.clip(column(left_out, "deviation_um"), -reach, reach)
            axes.plot(np.radians(column(left_out, "angle_deg")), shown, "x", color=REVIEW, markersize=4)
        axes.set_ylim(-2.5 * reach, 1.15 * reach)
        axes.set_yticks([-reach, 0, reach], [f"{-reach:.1f}", "0", f"{reach:+.1f} µm"])
        title = f"{SERIES.get(key[0], key[0])}, {key[1]}"
        panels.append(Panel(title, f"{title}: {len(used)} frames", svg(figure, f"{salt}-{index}")))
    return Drawing((Group("", tuple(panels)),) if panels else ())


def profile(rows: dict[str, list[Row]], salt: str) -> Drawing:
    """Height of each wheel's mean meridian, and below it the deviation from the nominal profile."""
    from matplotlib.figure import Figure

    panels = []
    for index, (key, points) in enumerate(by(rows["profile"], "side").items()):
        figure = Figure(figsize=(4.4, 3.7), layout="constrained")
        axes, below = figure.subplots(2, sharex=True, height_ratios=(1.4, 1))
        lateral = column(points, "lateral_mm")
        axes.plot(lateral, column(points, "height_mm"), color=POINT)
        axes.set_ylabel("height (mm)")
        below.axhline(0, color=REVIEW)
        below.plot(lateral, column(points, "deviation_um"), color=POINT)
        below.set_ylabel("from nominal (µm)")
        below.set_xlabel("from the datum circle (mm)")
        panels.append(Panel(f"{key[0]} wheel", f"Profile of the {key[0]} wheel", svg(figure, f"{salt}-{index}")))
    return Drawing((Group("", tuple(panels)),) if panels else ())


def deviation_map(rows: dict[str, list[Row]], salt: str) -> Drawing:
    """Each wheel unrolled: angle along, lateral place across, deviation as colour."""
    from matplotlib.figure import Figure

    panels = []
    for index, (key, bins) in enumerate(by(rows["map"], "side").items()):
        angle, lateral, deviation = (column(bins, name) for name in ("angle_deg", "lateral_mm", "deviation_um"))
        angles, across = np.unique(angle), np.unique(lateral)
        if len(angles) < 2 or len(across) < 2:
            continue
        shown = np.full((len(across), len(angles)), np.nan)
        shown[np.searchsorted(across, lateral), np.searchsorted(angles, angle)] = deviation
        reach = float(np.nanquantile(np.abs(deviation), 0.99)) or 1.0
        figure = Figure(figsize=(6.6, 2.7), layout="constrained")
        axes = figure.add_subplot()
        drawn = axes.pcolormesh(
            angles, across, shown, cmap="RdBu_r", vmin=-reach, vmax=reach, shading="nearest", rasterized=True
        )
        axes.set_xticks(np.arange(0, 361, 60))
        axes.set_xlabel("angle of the turn (°)")
        axes.set_ylabel("from the datum circle (mm)")
        figure.colorbar(drawn, ax=axes, label="deviation (µm)")
        alt = f"Deviation map of the {key[0]} wheel, {len(angles)} by {len(across)} bins"
        panels.append(Panel(f"{key[0]} wheel", alt, svg(figure, f"{salt}-{index}")))
    return Drawing((Group("", tuple(panels)),) if panels else ())


def _polar_axes() -> tuple[Figure, PolarAxes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.0, 4.0), layout="constrained")
    axes = figure.add_subplot(projection="polar")
    axes.set_rlabel_position(100)  # type: ignore[attr-defined]
    axes.tick_params(labelsize=7)
    return figure, axes  # type: ignore[return-value]
