"""`wheelset tool stripes`: sub-pixel centres of a laser stripe in any images, each with its standard uncertainty."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from pipelines.options import ConfigOption, JsonOption, print_json
from pipelines.tools import tool_app
from pipelines.tools.images import read_grey
from wheelset_assets.quality import ConfigError


class Axis(StrEnum):
    """Along which lines of pixels a centre is looked for."""

    rows = "rows"
    columns = "columns"


class Method(StrEnum):
    """How the centre is found."""

    centroid = "centroid"
    parabola = "parabola"
    steger = "steger"


@tool_app.command()
def stripes(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE…", help="Grey or colour images, 8-bit or 16-bit")],
    axis: Annotated[Axis, typer.Option("--axis", help="One centre for each row, or for each column")] = Axis.rows,
    method: Annotated[
        Method | None,
        typer.Option("--method", help="How a centre is found [default: centroid, or --config]", show_default=False),
    ] = None,
    min_contrast: Annotated[
        float | None,
        typer.Option(
            "--min-contrast", min=0, help="Smallest peak above its ground, of 255 [default: 12]", show_default=False
        ),
    ] = None,
    window_px: Annotated[int, typer.Option("--window", min=0, help="Half window; 0 follows the stripe's width")] = 0,
    out: Annotated[Path | None, typer.Option("--out", help="Write all centres to this CSV file")] = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> int:
    """Stripe centres of any images: one for each row, or with `--axis columns` one for each column.

    A row without a stripe has no centre. `sigma_px` follows from the image's grey noise and the stripe's slopes; speckle
    comes on top: `scatter_px` is how far neighbouring centres differ from a smooth line.
    """
    from wheelset_assets.config import load_config

    knobs = load_config(config).triangulation
    how = method.value if method else knobs.stripe_method
    contrast = knobs.stripe_min_contrast if min_contrast is None else min_contrast
    found = [_centres(path, axis, how, contrast, window_px) for path in images]
    for one in found:
        if not one["centres"]:
            print(f"wheelset: {one['file']}: no stripe: {one['reason']}", file=sys.stderr)
    if out is not None:
        _write(out, found)
    if as_json:
        print_json(found)
    else:
        _show(found, axis, out)
    return 0


def full_scale(image: NDArray[Any]) -> float:
    """Largest grey level that the camera can give: of 16-bit files, of 10, 12, 14 or 16 bits that the image reaches."""
    if image.dtype == np.uint8:
        return 255.0
    bits = int(image.max()).bit_length()
    return float(2 ** next((b for b in (8, 10, 12, 14) if bits <= b), 16) - 1)


def _centres(path: Path, axis: Axis, method: str, min_contrast: float, window_px: int) -> dict[str, Any]:
    from wheelset_assets.metrology.stripes import extract_centres

    image = read_grey(path)
    turned = np.ascontiguousarray(image if axis is Axis.rows else image.T)
    if turned.shape[1] < 16:
        raise ConfigError(f"{path}: {image.shape[1]} x {image.shape[0]} pixels: expected 16 or more across the stripe")
    scale = full_scale(image)
    c = extract_centres(turned[None], method, min_contrast, window_px, scale)
    line = np.flatnonzero(np.isfinite(c.u_px[0]))
    u = c.u_px[0, line]
    centres = [
        {
            "row": i if axis is Axis.rows else x,
            "column": x if axis is Axis.rows else i,
            "sigma_px": float(c.sigma_px[0, i]),
            "width_px": float(c.width_px[0, i]),
            "peak": float(c.peak[0, i]),
            "saturated": bool(c.saturated[0, i]),
        }
        for i, x in zip(line.tolist(), u.tolist(), strict=True)
    ]
    document: dict[str, Any] = {
        "file": str(path),
        "axis": axis.value,
        "method": method,
        "n_lines": turned.shape[0],
        "scatter_px": _scatter(c.u_px[0]),
        "full_scale": scale,
        "centres": centres,
    }
    if not centres:
        darkest, brightest = int(image.min()), int(image.max())
        document["reason"] = (
            f"no {axis.value[:-1]} has a narrow peak {min_contrast:g} of 255 levels above its ground and above its noise "
            f"(grey levels {darkest} to {brightest} of {scale:.0f}); is --axis {axis.value} right, or --min-contrast too high?"
        )
    return document


def _scatter(u_px: NDArray[np.float64]) -> float | None:
    """Robust standard deviation of a centre against its two neighbours on the line; None for fewer than ten."""
    second = (u_px[:-2] - 2 * u_px[1:-1] + u_px[2:]) / np.sqrt(6.0)
    second = second[np.isfinite(second)]
    return float(1.4826 * np.median(np.abs(second - np.median(second)))) if len(second) >= 10 else None


def _write(path: Path, found: list[dict[str, Any]]) -> None:
    import csv

    names = ("row", "column", "sigma_px", "width_px", "peak", "saturated")
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(("file", *names))
            for one in found:
                writer.writerows((one["file"], *(c[n] for n in names)) for c in one["centres"])
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def _show(found: list[dict[str, Any]], axis: Axis, out: Path | None) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(
        "file", f"{axis.value} with a centre", "sigma px", "scatter px", "width px", "peak", "saturated", box=None
    )
    for one in found:
        c = one["centres"]
        middle = lambda name, digits, c=c: f"{np.median([x[name] for x in c]):.{digits}f}" if c else ""  # noqa: E731
        table.add_row(
            one["file"],
            f"{len(c)} of {one['n_lines']}",
            middle("sigma_px", 4),
            "" if one["scatter_px"] is None else f"{one['scatter_px']:.4f}",
            middle("width_px", 2),
            middle("peak", 0),
            f"{100 * np.mean([x['saturated'] for x in c]):.0f} %" if c else "",
        )
    Console().print(table)
    print("Medians over the centres; width is the standard deviation of the profile. --json or --out give every centre."
          if out is None else f"centres: {out}")  # fmt: skip
