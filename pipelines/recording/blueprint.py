"""How a recording opens: tabs over what was drawn. A subject that has nothing to show gets no tab."""

from __future__ import annotations

import math

import rerun as rr
import rerun.blueprint as rrb

from pipelines.recording.canvas import Canvas
from pipelines.recording.rig import half_length_mm

BACKGROUND = (14, 16, 20)
TAB_NAMES = (
    "Overview",
    "Report",
    "Calibration",
    "Stripes",
    "Removed points",
    "Keypoints",
    "Residuals",
    "Meridian",
    "Turns",
)


def blueprint(canvas: Canvas, active_tab: str | None = None) -> rrb.Blueprint:
    """Tabs in the order of the stages; a scan that was not measured opens on its report."""
    made: dict[str, rrb.Container | rrb.View | None] = {
        "Overview": _overview(canvas),
        "Report": rrb.TextDocumentView(origin="documents/report", name="Report"),
        "Calibration": _calibration(canvas),
        "Stripes": _stripes(canvas),
        "Removed points": _removed(canvas),
        "Keypoints": _keypoints(canvas),
        "Residuals": _residuals(canvas),
        "Meridian": _meridian(canvas),
        "Turns": _turns(canvas),
    }
    tabs = {name: tab for name in TAB_NAMES if (tab := made[name]) is not None}
    for name, tab in tabs.items():
        tab.name = name
    first = "Overview" if canvas.source.state == "measured" else "Report"
    wanted = next(name for name in (active_tab, first, "Report") if name in tabs)
    return rrb.Blueprint(
        rrb.Tabs(*tabs.values(), active_tab=list(tabs).index(wanted)),
        rrb.TimePanel(state="collapsed", timeline="frame"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def _eye(canvas: Canvas, distance: float) -> rrb.EyeControls3D:
    reach = half_length_mm(canvas) * distance
    return rrb.EyeControls3D(
        position=(0.5 * reach, -1.8 * reach, 0.85 * reach), look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)
    )


def _space(
    canvas: Canvas, name: str, contents: list[str], origin: str = "rig", distance: float = 1.0
) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin=origin,
        contents=contents,
        name=name,
        background=BACKGROUND,
        line_grid=False,
        eye_controls=_eye(canvas, distance),
    )


def _overview(canvas: Canvas) -> rrb.Container | None:
    if "rig" not in canvas.drawn:
        return None
    hidden = ["rig/wheelset/removed", "rig/wheelset/residual"]
    if "fused" in canvas.drawn:
        hidden.append("rig/wheelset/triangulated")
    view = _space(canvas, "Rig and wheelset", ["+ rig/**", *(f"- {path}/**" for path in hidden)])
    words = rrb.TextDocumentView(origin="documents/summary", name="Result")
    return rrb.Horizontal(view, words, column_shares=[5, 2])


def _removed(canvas: Canvas) -> rrb.Container | None:
    if "removed" not in canvas.drawn:
        return None
    view = _space(
        canvas,
        "Removed points",
        ["+ rig/axle/**", "+ rig/wheelset/removed/**", "+ rig/wheelset/triangulated/**"],
        origin="rig/wheelset",
        distance=0.85,
    )
    maps = [
        rrb.Spatial2DView(
            origin=path, contents=[f"+ {path}/**"], name=path.removeprefix("removed/"), background=BACKGROUND
        )
        for path in canvas.drawn.get("removal maps", [])
    ]
    words = rrb.TextDocumentView(origin="documents/removed", name="By sensor and reason")
    return rrb.Horizontal(rrb.Vertical(view, words, row_shares=[5, 2]), rrb.Vertical(*maps), column_shares=[3, 2])


def _stripes(canvas: Canvas) -> rrb.Container | rrb.View | None:
    words = rrb.TextDocumentView(origin="documents/stripes", name="Stripes read")
    pairs = _image_pairs(canvas, "stripes")
    if not pairs:
        return words
    return rrb.Horizontal(rrb.Grid(*pairs, grid_columns=math.ceil(math.sqrt(len(pairs)))), words, column_shares=[5, 2])


def _calibration(canvas: Canvas) -> rrb.Container | None:
    pairs = _image_pairs(canvas, "calibration")
    if not pairs:
        return None
    words = rrb.TextDocumentView(origin="documents/calibration", name="Fit and poses")
    return rrb.Horizontal(rrb.Grid(*pairs, grid_columns=math.ceil(math.sqrt(len(pairs)))), words, column_shares=[5, 3])


def _image_pairs(canvas: Canvas, subject: str) -> list[rrb.Container]:
    """Left and right image of every sensor of a subject, side by side."""
    sensors = canvas.drawn.get(subject, [])
    if canvas.source.rig is None:
        return []
    sizes = {s.sensor_id: s.image_size for s in canvas.source.rig.sensors}
    pairs: list[rrb.Container] = []
    for name in (n for n in sensors if n in sizes):
        width, height = sizes[name]
        bounds = rrb.VisualBounds2D(x_range=(-0.03 * width, 1.03 * width), y_range=(-0.12 * height, 1.03 * height))
        sides = [
            rrb.Spatial2DView(
                origin=f"{subject}/{name}/{side}",
                name=f"{name} {side}",
                titlebar=False,
                background=BACKGROUND,
                visual_bounds=bounds,
            )
            for side in ("left", "right")
        ]
        pairs.append(rrb.Horizontal(*sides, name=name))
    return pairs


def _keypoints(canvas: Canvas) -> rrb.Container | None:
    views = _framed(canvas, "keypoints")
    if not views:
        return None
    grid = rrb.Grid(*views, grid_columns=math.ceil(math.sqrt(len(views))))
    if "keypoints" not in canvas.drawn.get("documents", []):
        return rrb.Horizontal(grid)
    return rrb.Vertical(grid, rrb.TextDocumentView(origin="documents/keypoints", name="Matches"), row_shares=[3, 1])


def _framed(canvas: Canvas, subject: str) -> list[rrb.Spatial2DView]:
    """A 2-D view for each station of a subject, with the frame that was set when it was drawn."""
    views = []
    for name in canvas.drawn.get(subject, []):
        frame = canvas.frames[f"{subject}/{name}"]
        bounds = rrb.VisualBounds2D(x_range=frame.x_range, y_range=frame.y_range)
        views.append(
            rrb.Spatial2DView(origin=f"{subject}/{name}", name=frame.title, background=BACKGROUND, visual_bounds=bounds)
        )
    return views


def _residuals(canvas: Canvas) -> rrb.Container | None:
    if "residual" not in canvas.drawn:
        return None
    view = _space(
        canvas,
        "Distance between sensors",
        ["+ rig/axle/**", "+ rig/wheelset/residual/**"],
        origin="rig/wheelset",
        distance=0.7,
    )
    return rrb.Vertical(view, rrb.TextDocumentView(origin="documents/residual", name="Scale"), row_shares=[6, 1])


def _meridian(canvas: Canvas) -> rrb.Container | None:
    views = _framed(canvas, "meridian")
    return rrb.Grid(*views, grid_columns=math.ceil(math.sqrt(len(views)))) if views else None


def _turns(canvas: Canvas) -> rrb.Container | None:
    views = [
        rrb.TimeSeriesView(
            origin=f"turns/{name}",
            name=f"{name.replace('_', ' ')}, departure from the mean in µm",
            plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
            time_ranges=[
                rr.VisibleTimeRange(t, start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
                for t in ("frame", "angle_mdeg")
            ],
        )
        for name in canvas.drawn.get("turns", [])
    ]
    return rrb.Grid(*views, grid_columns=min(2, len(views))) if views else None
