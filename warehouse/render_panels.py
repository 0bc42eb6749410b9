"""What every figure is made of: panels and groups, the style, axes, and how a picture becomes SVG that a page can hold.

No number is made here, and no text that comes from data is drawn: names stand beside the picture, where they are
escaped. The same tables give the same bytes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Row = dict[str, Any]

POINT, REVIEW, FAINT, MEAN = "#0072b2", "#b34700", "#767676", "#111111"
BAND = "#f3d3bd"
MANY = 800
STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.2,
    "timezone": "UTC",
}


@dataclass(frozen=True)
class Panel:
    """One picture, with the words that stand beside it."""

    title: str
    alt: str
    svg: str


@dataclass(frozen=True)
class Group:
    """Panels under one head: a wheelset, or the whole figure where `head` is empty."""

    head: str
    panels: tuple[Panel, ...]


@dataclass(frozen=True)
class Drawing:
    """A figure that was drawn, and what was left out of it."""

    groups: tuple[Group, ...]
    note: str = ""


def by(rows: Iterable[Row], *names: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by the values of some columns, in their order."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return groups


def column(rows: Iterable[Row], name: str, factor: float = 1.0) -> np.ndarray:
    """A column as floats, null as NaN."""
    return np.array([np.nan if row[name] is None else factor * row[name] for row in rows], dtype=float)


def title_of(quantity: str, side: str) -> str:
    """Words for a quantity and side."""
    words = quantity.replace("_", " ")
    return words if side == "both" else f"{words}, {side}"


def axes_of() -> tuple[Figure, Axes]:
    """A figure of one panel."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.4, 2.5), layout="constrained")
    return figure, figure.add_subplot()


def dates(axes: Axes) -> None:
    """Dates along x, few and short."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    locator = AutoDateLocator(minticks=3, maxticks=7)
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))


def svg(figure: Figure, salt: str) -> str:
    """The figure as an SVG element to stand in a page among others: no address, no date, identifiers of its own."""
    buffer = StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(buffer, format="svg", metadata=nothing, dpi=200, transparent=True)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)
    text = text.replace("xlink:href", "href")
    text = re.sub(r'( id="|href="#|url\(#)', rf"\g<1>{salt}-", text)
    return re.sub(
        r'<svg [^>]*?viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" aria-hidden="true">', text, count=1
    ).strip()
