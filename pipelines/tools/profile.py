"""`wheelset tool profile`: flange height, flange thickness, qR and more of wheel profiles from other instruments."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pipelines.options import JsonOption, print_json
from pipelines.tools import tool_app
from wheelset_assets.quality import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

DATUM_MM = 70.0
FACE_MM = 1.0
"""Points within this of the innermost lateral place may belong to the inner face."""
MIN_FACE_MM = 3.0


@dataclass(frozen=True)
class Section:
    """One profile: lateral from the datum circle (n,), height (n,), mm, flange at negative lateral places, and notes."""

    s_mm: Array
    z_mm: Array
    notes: tuple[str, ...] = ()


@tool_app.command()
def profile(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE…", help="MiniProf (.whl .ban), SIMPACK (.prw) or text of two columns: lateral, height"
        ),
    ],
    align: Annotated[
        str,
        typer.Option(
            "--align",
            help="Lateral zero: inner-face (line through the seen back face), frame (as the file says), or auto: the "
            "inner face where 3 mm of it were seen",
        ),
    ] = "auto",
    origin: Annotated[
        str,
        typer.Option(
            "--origin",
            help="Where a text file's lateral coordinate is zero: datum, inner-face, or auto: datum if it has values "
            "below -20 mm",
        ),
    ] = "auto",
    nominal: Annotated[
        str | None,
        typer.Option(
            "--nominal", help="Nominal profile to compare with: a name of the library, or a CSV with s_mm,z_mm"
        ),
    ] = None,
    l1: Annotated[
        float, typer.Option("--l1", min=0.1, help="Drop of qR's upper point below the flange's top, mm")
    ] = 2.0,
    l2: Annotated[float, typer.Option("--l2", min=1.0, help="Datum circle from the inner face, mm")] = DATUM_MM,
    l3: Annotated[
        float, typer.Option("--l3", min=0.1, help="Height of the flange thickness above the tread, mm")
    ] = 10.0,
    as_json: JsonOption = False,
) -> int:
    """Wheel profile quantities of single sections, defined as for the rig's scans; the alignment is named.

    A section that lacks what a quantity needs gives null and the reason. The header of a MiniProf file is recomputed and
    compared: copied headers are common.
    """
    if align not in ("auto", "inner-face", "frame"):
        raise ConfigError(f"--align {align}: known are auto, inner-face and frame")
    if origin not in ("auto", "datum", "inner-face"):
        raise ConfigError(f"--origin {origin}: known are auto, datum and inner-face")
    rows = [evaluated(path, align, origin, nominal, (l1, l2, l3)) for path in files]
    if as_json:
        print_json(rows)
    else:
        _show(rows)
    return 0


def evaluated(
    path: Path, align: str, origin: str, nominal: str | None, lengths: tuple[float, float, float]
) -> dict[str, Any]:
    """Quantities of one file; ConfigError names the file and what was expected."""
    import numpy as np

    from wheelset_assets.metrology.profile import ProfileDefinition, flange_top, profile_deviation, profile_values

    l1, l2, l3 = lengths
    section = read_section(path, origin)
    s, z, named, notes = _aligned(section, align)
    definition = ProfileDefinition(l2, l3, l1, 10.0)
    weight = np.ones(len(s))
    found = profile_values(s, z, weight, definition)
    reasons: dict[str, str] = {}
    row: dict[str, Any] = {"file": str(path)}
    lacks = {
        "flange_height_mm": "the flange's top or the tread at the datum circle was not seen",
        "flange_thickness_mm": "the flange's flank, top or the tread at the datum circle was not seen",
        "qr_mm": "the flange's flank, top or the tread at the datum circle was not seen",
    }
    for name, why in lacks.items():
        value = float(getattr(found, name))
        row[name] = value if np.isfinite(value) else None
        if row[name] is None:
            reasons[name] = why
    if nominal:
        new = _nominal(nominal)
        base = profile_values(new.s_mm, new.z_mm, np.ones(len(new.s_mm)), definition)
        known = row["flange_height_mm"] is not None and np.isfinite(base.flange_height_mm)
        row["tread_wear_mm"] = row["flange_height_mm"] - float(base.flange_height_mm) if known else None
        deviation = profile_deviation(s, z, flange_top(s, z, weight, definition), new, definition)
        good = deviation[np.isfinite(deviation)]
        row["nominal"] = new.name
        row["deviation_rms_mm"] = float(np.sqrt(np.mean(good**2))) if good.size else None
        row["deviation_max_mm"] = float(good[np.abs(good).argmax()]) if good.size else None
    row |= {
        "n_points": len(s),
        "alignment": named,
        "l1_mm": l1,
        "l2_mm": l2,
        "l3_mm": l3,
        "reasons": reasons,
        "notes": [*notes, *section.notes],
    }
    return row


def read_section(path: Path, origin: str = "auto") -> Section:
    """Profile of a file by its kind, flange up and at negative lateral places."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    kind = _kind(path, text)
    if kind == "miniprof":
        from wheelset_assets.exchange import miniprof

        found = miniprof.read(text, str(path))
        wrong = [f"header: {line}" for line in miniprof.disagreements(found)]
        return _oriented(found.s_mm, found.z_mm, tuple(wrong), path)
    if kind == "simpack":
        from wheelset_assets.exchange import simpack

        s, z = simpack.read(text, str(path))
        return _oriented(s, z, (), path)
    s, z = _columns(path, text)
    counted = origin if origin != "auto" else ("datum" if s.min() < -20.0 else "inner-face")
    shift = DATUM_MM if counted == "inner-face" else 0.0
    return _oriented(s - shift, z, (f"lateral zero of the file: {counted}",), path)


def _kind(path: Path, text: str) -> Literal["miniprof", "simpack", "text"]:
    if "spline.begin" in text or path.suffix.lower() == ".prw":
        return "simpack"
    if path.suffix.lower() in (".whl", ".ban", ".mpt") or "ColumnDef" in text or "MINIPROF" in text[:400].upper():
        return "miniprof"
    return "text"


def _columns(path: Path, text: str) -> tuple[Array, Array]:
    """First two columns of numbers of a text; lines of words are a header."""
    import numpy as np

    rows = []
    for line in text.splitlines():
        # A comma between digits of a file that is split by semicolons is a decimal comma.
        parts = line.replace(",", ".").split(";") if ";" in line else line.replace(",", " ").split()
        try:
            rows.append((float(parts[0]), float(parts[1])))
        except (ValueError, IndexError):
            continue
    data = np.array(rows, float).reshape(-1, 2)
    data = data[np.isfinite(data).all(axis=1)]
    if len(data) < 20:
        raise ConfigError(f"{path}: expected lines of lateral, height in mm, 20 or more; found {len(data)}")
    return data[:, 0], data[:, 1]


def _oriented(s: Array, z: Array, notes: tuple[str, ...], path: Path) -> Section:
    """The section with its flange at negative lateral places and upward."""
    import numpy as np

    s, z = np.asarray(s, float), np.asarray(z, float)
    order = np.argsort(s, kind="stable")
    middle = np.abs(s - np.median(s)) < 20.0
    if not middle.any() or np.ptp(s) < 40.0:
        raise ConfigError(f"{path}: a wheel profile spans 40 mm or more; found {np.ptp(s):.1f} mm")
    level = float(np.median(z[middle]))
    if level - z.min() > 1.5 * (z.max() - level) and level - z.min() > 15.0 and _is_peak(s, -z):
        z, notes = -z, (*notes, "heights were negative upward; turned over")
    if s[np.argmax(z)] > np.median(s):
        s, notes = -s, (*notes, "flange at positive lateral places; mirrored")
        order = np.argsort(s, kind="stable")
    return Section(s[order], z[order], notes)


def _is_peak(s: Array, z: Array) -> bool:
    """Whether the highest point lies inside, as a flange's top does, and not at an end."""
    place = float(s[z.argmax()])
    return bool(s.min() + 3.0 < place < s.max() - 3.0)


def _aligned(section: Section, align: str) -> tuple[Array, Array, str, list[str]]:
    """Lateral from the inner face (n,), heights (n,), the alignment's name, and notes."""
    import numpy as np

    s, z = section.s_mm, section.z_mm
    near = (s < s.min() + FACE_MM) & (z < z.max() - 12.0)
    seen = float(np.ptp(z[near])) if near.sum() >= 5 else 0.0
    if align == "inner-face" and seen < MIN_FACE_MM:
        raise ConfigError(f"--align inner-face: {seen:.1f} mm of the inner face were seen, {MIN_FACE_MM:g} are needed")
    if align == "frame" or seen < MIN_FACE_MM:
        return s + DATUM_MM, z, "frame of the file", []
    face = float(np.median(s[near]))
    return s - face, z, "inner face", [f"inner face at {face + DATUM_MM:+.3f} mm of the file's own"]


def _nominal(name: str) -> Any:
    from warehouse.nominal import nominal, read_profile

    path = Path(name)
    found = read_profile(path) if path.suffix.lower() == ".csv" else nominal(Path(), name)
    if isinstance(found, str):
        raise ConfigError(f"--nominal: {found}")
    return found


def _show(rows: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    names = [n for n in rows[0] if n.endswith("_mm") and not n.startswith("l")]
    table = Table()
    table.add_column("file")
    for name in names:
        table.add_column(name.removesuffix("_mm") + " (mm)", justify="right")
    table.add_column("alignment")
    for row in rows:
        values = ["-" if row[n] is None else f"{row[n]:.4f}" for n in names]
        table.add_row(Path(row["file"]).name, *values, row["alignment"])
    console = Console()
    console.print(table)
    for row in rows:
        for name, why in row["reasons"].items():
            console.print(f"{row['file']}: {name}: {why}", markup=False)
        for note in row["notes"]:
            console.print(f"{row['file']}: {note}", markup=False)
