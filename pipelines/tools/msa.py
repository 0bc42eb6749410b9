"""`wheelset tool msa`: gauge study of any CSV file: ANOVA, gauge R&R, type-1 study, linearity, ISO 5725."""

from __future__ import annotations

import csv
from dataclasses import asdict
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipelines.options import JsonOption, print_json
from pipelines.tools import tool_app
from wheelset_assets.quality import ConfigError

if TYPE_CHECKING:
    import numpy as np


@tool_app.command()
def msa(
    file: Annotated[Path, typer.Argument(metavar="FILE.csv", help="CSV with a header, one reading a line")],
    value: Annotated[str, typer.Option("--value", help="Column of the readings")],
    part: Annotated[str | None, typer.Option("--part", help="Column that names the part")] = None,
    operator: Annotated[
        str | None, typer.Option("--operator", help="Column of the operator, day or rig; without it: one-way")
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option("--tolerance", help="Width of the tolerance, in the values' unit")
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option(
            "--reference", help="Column of reference values (linearity), or one number (type-1 study: Cg, Cgk)"
        ),
    ] = None,
    resolution: Annotated[float | None, typer.Option("--resolution", help="Smallest step of the display")] = None,
    as_json: JsonOption = False,
) -> int:
    """Measurement system analysis of a CSV file.

    With `--part` (and `--operator`): ANOVA, variance components, gauge R&R, distinct categories, ISO 5725 precision.
    With `--reference` as a number and `--tolerance`: type-1 study. With `--reference` as a column: bias and linearity.
    Readings are taken as decimal numbers, as they stand in the file: a large part that they share costs no digits.
    """
    document = study(file, value, part, operator, tolerance, reference, resolution)
    if as_json:
        print_json(document)
    else:
        _show(document)
    return 0


def study(
    file: Path,
    value: str,
    part: str | None = None,
    operator: str | None = None,
    tolerance: float | None = None,
    reference: str | None = None,
    resolution: float | None = None,
) -> dict[str, Any]:
    """The analysis as one document; ConfigError names file, line and column of what is wrong."""
    from wheelset_assets.metrology import anova

    if part is None and reference is None:
        raise ConfigError("tool msa: name the column of the parts by --part, or a reference by --reference")
    number = _number(reference)
    columns = [name for name in (value, part, operator, None if number is not None else reference) if name is not None]
    rows = _read(file, columns)
    offset, values = _shifted(file, rows, value)
    document: dict[str, Any] = {"file": str(file), "n": len(rows), "mean": float(offset) + float(values.mean())}
    if resolution is not None and tolerance is not None:
        document["resolution_percent_of_tolerance"] = 100 * resolution / tolerance
    try:
        if part is not None:
            parts = [row[part] for row in rows]
            operators = [row[operator] for row in rows] if operator is not None else None
            document |= _gauge(anova.gauge_study(values, parts, operators, tolerance))
            s = document["standard_deviations"]
            document["precision"] = {
                "s_r": s["repeatability"],
                "s_reproducibility": s["gauge"],
                "repeatability_limit": 2.8 * s["repeatability"],
                "reproducibility_limit": 2.8 * s["gauge"],
            }
        if number is not None:
            if tolerance is None:
                raise ValueError("a type-1 study needs --tolerance")
            single = asdict(anova.type_one(values, float(number - offset), tolerance, resolution))
            document["type_one"] = single | {"mean": single["mean"] + float(offset), "reference": float(number)}
        elif reference is not None:
            import numpy as np

            references = [Decimal(_decimal(file, row, reference)) for row in rows]
            biases = np.array([float(Decimal(row[value]) - r) for row, r in zip(rows, references, strict=True)])
            at = np.array([float(r) for r in references])
            document["linearity"] = asdict(anova.linearity(biases + at, at))
    except ValueError as error:
        raise ConfigError(f"{file}: {error}") from error
    return document


def _gauge(found: Any) -> dict[str, Any]:
    """The study under the names of the contract, and what else it knows."""
    return {
        "design": found.design,
        "anova": [asdict(line) for line in found.anova],
        "variance_components": found.variance_components,
        "standard_deviations": found.standard_deviations,
        "grr_percent": found.grr_percent,
        "grr_percent_of_tolerance": found.grr_percent_of_tolerance,
        "ndc": found.ndc,
        "pooling": found.pooling,
        "r_squared": found.r_squared,
        "notes": list(found.notes),
    }


def _number(text: str | None) -> Decimal | None:
    try:
        return Decimal(text) if text is not None else None
    except InvalidOperation:
        return None


def _read(file: Path, columns: list[str]) -> list[dict[str, str]]:
    try:
        with file.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.DictReader(stream)
            names = [name.strip() for name in reader.fieldnames or []]
            reader.fieldnames = names
            for name in columns:
                if name not in names:
                    raise ConfigError(f"{file}: no column {name!r}; it has {', '.join(names) or 'none'}")
            rows = []
            for row in reader:
                if not any((cell or "").strip() for name, cell in row.items() if isinstance(name, str)):
                    continue
                kept = {name: (row[name] or "").strip() for name in columns} | {"": str(reader.line_num)}
                for name in columns:
                    if not kept[name]:
                        raise ConfigError(f"{file}, line {reader.line_num}, column {name}: empty")
                rows.append(kept)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from error
    if not rows:
        raise ConfigError(f"{file}: no reading in it")
    return rows


def _decimal(file: Path, row: dict[str, str], column: str) -> Decimal:
    try:
        found = Decimal(row[column])
    except InvalidOperation:
        found = Decimal("nan")
    if not found.is_finite():
        raise ConfigError(f"{file}, line {row['']}, column {column}: expected a finite number; found {row[column]!r}")
    return found


def _shifted(file: Path, rows: list[dict[str, str]], column: str) -> tuple[Decimal, np.ndarray]:
    """The first reading, and all readings less it: taken as decimals, so that the differences are the file's own."""
    import numpy as np

    decimals = [_decimal(file, row, column) for row in rows]
    return decimals[0], np.array([float(d - decimals[0]) for d in decimals])


def _show(document: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    console.print(f"{document['file']}: {document['n']} readings, mean {document['mean']:.9g}", markup=False)
    if "anova" in document:
        table = Table("source", "df", "sum of squares", "mean square", "F", "p", show_edge=False)
        for line in document["anova"]:
            tested = [f"{line[name]:.4g}" if line[name] is not None else "" for name in ("f", "p")]
            table.add_row(line["source"], str(line["df"]), f"{line['sum_sq']:.9g}", f"{line['mean_sq']:.9g}", *tested)
        console.print(table)
        table = Table("source", "variance", "standard deviation", "% of total", show_edge=False)
        total = document["standard_deviations"]["total"] or 1.0
        for name, variance in document["variance_components"].items():
            s = document["standard_deviations"][name]
            table.add_row(name, f"{variance:.6g}", f"{s:.6g}", f"{100 * s / total:.2f}")
        console.print(table)
        console.print(f"pooling: {document['pooling']}", markup=False)
        share = document["grr_percent_of_tolerance"]
        ndc = "none" if document["ndc"] is None else f"{document['ndc']:.2f}"
        console.print(
            f"GRR {document['grr_percent']:.2f} % of the total"
            + (f", {share:.2f} % of the tolerance (6 s)" if share is not None else "")
            + f"; distinct categories {ndc}"
        )
    for name in ("precision", "type_one", "linearity"):
        if name in document:
            shown = (f"{key} {v:.6g}" if isinstance(v, float) else f"{key} {v}" for key, v in document[name].items())
            console.print(f"{name}: " + ", ".join(shown), markup=False)
    for note in document.get("notes", []):
        console.print(f"note: {note}", markup=False)
