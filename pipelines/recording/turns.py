"""The turn: radius at the datum circle, faces and journals frame by frame, as departures from their mean in um."""

from __future__ import annotations

import numpy as np
import rerun as rr

from pipelines.recording.canvas import RED, Canvas

SERIES = ("tread_radius", "face_lateral", "journal_radius", "shoulder_lateral")
SIDE_COLOURS = ((86, 156, 236), (245, 158, 66), (84, 190, 120), (226, 108, 140))


def draw(canvas: Canvas) -> None:
    """One plot a series: values that entered the fit, those excluded, and the fitted harmonics, for each station."""
    table = canvas.source.table("turns")
    if table is None or not table.num_rows:
        return
    series = np.asarray(table["series"].to_pylist(), object)
    station = np.asarray(table["station"].to_pylist(), object)
    frame, value, fitted = (table[name].to_numpy() for name in ("frame", "value_mm", "fitted_mm"))
    used = table["used"].to_numpy(zero_copy_only=False)
    for name in dict.fromkeys(series):
        stations = list(dict.fromkeys(station[series == name]))
        for number, where in enumerate(stations):
            member = np.flatnonzero((series == name) & (station == where))
            member = member[np.argsort(frame[member], kind="stable")]
            mean = float(np.mean(fitted[member]))
            path = f"turns/{name}/{where}"
            colour = SIDE_COLOURS[number % len(SIDE_COLOURS)]
            label = f"{where}, mean {mean:.4f} mm"
            fit = rr.SeriesLines(colors=[colour], widths=[1.5], names=[f"{where}, harmonics"])
            _send(canvas, f"{path}/harmonics", frame[member], (fitted[member] - mean) * 1e3, fit)
            good, bad = member[used[member]], member[~used[member]]
            points = rr.SeriesPoints(colors=[colour], markers="circle", marker_sizes=[2.0], names=[label])
            _send(canvas, f"{path}/used", frame[good], (value[good] - mean) * 1e3, points)
            crosses = rr.SeriesPoints(colors=[RED], markers="cross", marker_sizes=[4.0], names=[f"{where}, excluded"])
            _send(canvas, f"{path}/excluded", frame[bad], (value[bad] - mean) * 1e3, crosses)
        canvas.note("turns", name)


def _send(canvas: Canvas, path: str, frame: np.ndarray, value_um: np.ndarray, style: rr.AsComponents) -> None:
    if len(frame):
        canvas.static(path, style)
        canvas.rec.send_columns(path, indexes=canvas.times(frame), columns=rr.Scalars.columns(scalars=value_um))
