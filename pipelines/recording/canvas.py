"""What all subjects share: the stream, colours by sensor and reason, timelines, thinning, and the turn undone.

Paths: `rig/…` is in the rig's frame (mm), `rig/wheelset/…` in the wheelset's, which turns in it as the frames go by.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from pipelines.recording.source import Source

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

SENSOR_COLOURS: tuple[Colour, ...] = (
    (86, 156, 236),
    (245, 158, 66),
    (84, 190, 120),
    (226, 108, 140),
    (176, 136, 230),
    (222, 200, 80),
    (96, 204, 210),
    (196, 140, 100),
    (236, 130, 214),
    (150, 200, 90),
)
REASON_COLOURS: dict[str, Colour] = {
    "range": (255, 80, 80),
    "outlier": (255, 200, 40),
    "isolated": (70, 200, 255),
}
GREY: Colour = (120, 125, 135)
PALE: Colour = (205, 210, 220)
RED: Colour = (255, 80, 80)
WHITE: Colour = (240, 240, 240)


@dataclass(frozen=True)
class Frame:
    """What a 2-D view is to show: its title, and the ranges across and down."""

    title: str
    x_range: tuple[float, float]
    y_range: tuple[float, float]


@dataclass
class Canvas:
    """A recording under way: what is drawn so far is in `drawn`, by subject, for the blueprint to arrange."""

    rec: rr.RecordingStream
    source: Source
    max_points: int
    drawn: dict[str, list[str]] = field(default_factory=dict)
    frames: dict[str, Frame] = field(default_factory=dict)

    def note(self, subject: str, what: str = "") -> None:
        """Remember that a subject has something to show."""
        items = self.drawn.setdefault(subject, [])
        if what and what not in items:
            items.append(what)

    def static(self, path: str, *things: rr.AsComponents) -> None:
        """Log what does not change with the frames."""
        self.rec.log(path, *things, static=True)

    def document(self, name: str, text: str) -> None:
        """Log a Markdown document."""
        self.static(f"documents/{name}", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
        self.note("documents", name)

    def colour(self, sensor_id: str) -> Colour:
        """A sensor's colour, the same in every view."""
        names = [s.sensor_id for s in self.source.rig.sensors] if self.source.rig else []
        return SENSOR_COLOURS[(names.index(sensor_id) if sensor_id in names else len(names)) % len(SENSOR_COLOURS)]

    def times(self, frame: NDArray) -> list[rr.TimeColumn]:
        """Timelines of some frames: their number, and the angle of the turn if it is known."""
        columns = [rr.TimeColumn("frame", sequence=np.asarray(frame, np.int64))]
        angle = self.source.angle_deg
        if angle is not None and len(frame) and int(np.max(frame)) < len(angle):
            columns.append(rr.TimeColumn("angle_mdeg", sequence=np.rint(angle[frame] * 1e3).astype(np.int64)))
        return columns

    def thin(self, n: int) -> NDArray[np.int64]:
        """Indices of at most max_points of n rows, evenly spaced."""
        return np.arange(n) if n <= self.max_points else np.linspace(0, n - 1, self.max_points).astype(np.int64)

    def unturned(self, points_mm: Array, frame: NDArray) -> Array:
        """Points (n, 3) of the rig frame in the wheelset's: turned back about X by their frame's angle, if it is known."""
        angle = self.source.angle_deg
        if angle is None or not len(frame) or int(np.max(frame)) >= len(angle):
            return points_mm
        c, s = np.cos(np.radians(angle[frame])), np.sin(np.radians(angle[frame]))
        x, y, z = points_mm.T
        return np.column_stack([x, c * y + s * z, c * z - s * y])


def ui(points: float) -> list[float]:
    """Radius in points of the screen, whatever the zoom: to the viewer, negative numbers mean that."""
    return [-points]


def sensor_codes(table: pa.Table) -> tuple[NDArray, list[str]]:
    """Codes and names of a table's sensor_id, whether it is stored as a category or as text."""
    column = table["sensor_id"].combine_chunks()
    encoded = column if pa.types.is_dictionary(column.type) else column.dictionary_encode()
    return encoded.indices.to_numpy(zero_copy_only=False), encoded.dictionary.to_pylist()
