"""The documents in words: what became of the scan, its values with uncertainty and flags, temperatures, calibration.

Markdown text from stored rows; nothing is drawn here, and nothing judged.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from pipelines.recording.source import Source
from warehouse.lineage import BUNDLE
from wheelset_assets.stages import SCAN_STAGES

NONE = "–"
STAGE_WORDS = {BUNDLE: "verification of the bundle"}


class Col(NamedTuple):
    """A column of a listing: its heading, the stored column, and how a number is written."""

    head: str
    name: str
    form: str = ""


MEASUREMENTS = (
    Col("quantity", "quantity"),
    Col("side", "side"),
    Col("value", "value", ".4f"),
    Col("U", "expanded_uncertainty", ".4f"),
    Col("unit", "unit"),
    Col("flags", "quality_flags"),
    Col("reason", "reason"),
)
CALIBRATIONS = (
    Col("sensor", "sensor_id"),
    Col("state", "state"),
    Col("poses", "n_poses", "d"),
    Col("used", "n_poses_used", "d"),
    Col("left", "left_rms_px", ".3f"),
    Col("right", "right_rms_px", ".3f"),
    Col("stereo", "stereo_rms_px", ".3f"),
    Col("held out", "holdout_rms_px", ".3f"),
    Col("epipolar", "epipolar_rms_px", ".3f"),
    Col("baseline mm", "baseline_mm", ".3f"),
    Col("lens", "distortion_model"),
    Col("reason", "reason"),
)
STRIPES = (
    Col("sensor", "sensor_id"),
    Col("line", "line", "d"),
    Col("frames", "n_frames", ",d"),
    Col("centres left", "n_centres_left", ",d"),
    Col("centres right", "n_centres_right", ",d"),
    Col("points", "n_points", ",d"),
    Col("noise px", "centre_noise_px", ".3f"),
)
REGISTRATIONS = (
    Col("station", "station"),
    Col("source", "source_sensor_id"),
    Col("target", "target_sensor_id"),
    Col("method", "method"),
    Col("RMSE mm", "inlier_rmse_mm", ".4f"),
    Col("fitness", "fitness", ".3f"),
    Col("constrained", "n_constrained", "d"),
    Col("lateral mm", "correction_lateral_mm", ".3f"),
    Col("radial mm", "correction_radial_mm", ".3f"),
    Col("meridian °", "correction_meridian_deg", ".3f"),
    Col("flags", "quality_flags"),
)
ALIGNMENTS = (
    Col("station", "station"),
    Col("face at X mm", "face_lateral_mm", ".3f"),
    Col("from radius mm", "face_radial_min_mm", ".1f"),
    Col("to", "face_radial_max_mm", ".1f"),
    Col("RMS µm", "face_rms_um", ".2f"),
    Col("squaring °", "squaring_deg", ".4f"),
    Col("by", "squared_by"),
    Col("flags", "quality_flags"),
    Col("reason", "reason"),
)
READINGS = (
    Col("reading", "quantity"),
    Col("side", "side"),
    Col("value", "reading", ".4f"),
    Col("u noise", "u_noise", ".5f"),
    Col("frames", "n_frames", "d"),
    Col("turn seen", "angular_coverage_ratio", ".0%"),
    Col("excluded", "excluded_ratio", ".1%"),
    Col("flags", "quality_flags"),
    Col("reason", "reason"),
)
SUMMARY = (Col("quantity", "quantity"), Col("side", "side"), MEASUREMENTS[2], MEASUREMENTS[3])


def headline(source: Source) -> str:
    """State of the scan, and where and why it ended, in one line."""
    if source.reason is None:
        return (
            f"**{source.state}**" if source.state == "measured" else f"**{source.state}** after {_stage(source.stage)}"
        )
    return f"**{source.state}** at {_stage(source.stage)}: {escape(source.reason.splitlines()[0])}"


def report(source: Source) -> str:
    """The whole report; its first line is the headline."""
    details = source.reason.splitlines()[1:] if source.reason else []
    parts = [headline(source), *map(escape, details), f"# {source.scan_id}", _facts(source), _measurements(source)]
    parts += [
        _stages(source),
        _calibration(source),
        _section("Stripes", listing(STRIPES, source.rows("stripe_statistics"))),
        _section("Registration", listing(REGISTRATIONS, source.rows("registrations"))),
        _section("Alignment", listing(ALIGNMENTS, source.rows("alignments"))),
        _section("Readings before the comparison", listing(READINGS, source.rows("readings"))),
        _section("What this recording lacks", _notes(source)),
    ]
    return "\n\n".join(part for part in parts if part)


def summary(source: Source) -> str:
    """Headline and values only, to stand beside the 3-D view."""
    header, found, about = source.header, source.rows("measurements"), ""
    if header:
        who = f"{header.wheelset.wheelset_id} ({header.wheelset.type}), {header.captured_at:%Y-%m-%d %H:%M}"
        about = escape(f"{who}; {_temperatures(source)}")
    reasons = sorted({r["reason"] for r in found if r["reason"]})
    why = "No value because:\n\n" + "\n".join(f"- {escape(reason)}" for reason in reasons) if reasons else ""
    return "\n\n".join(part for part in (headline(source), about, listing(SUMMARY, found), why) if part)


def _facts(source: Source) -> str:
    header = source.header
    if header is None:
        return "The bundle was refused, so nothing is known of the scan but its name."
    profile, angle = header.wheelset.profile or "not named", source.angle_deg
    rows = [
        ("wheelset", f"{header.wheelset.wheelset_id} ({header.wheelset.type}), nominal profile {profile}"),
        ("purpose", header.purpose),
        ("captured at", header.captured_at.isoformat()),
        ("rig", header.rig_id),
        ("temperatures", _temperatures(source)),
        ("frames", "angles not on record" if angle is None else f"{len(angle)} over {angle[-1] - angle[0]:.1f}°"),
        ("calibration", header.calibration_id),
        ("run", source.deciding.run_id),
        ("program", source.deciding.git_commit),
        *((name, getattr(header, name)) for name in ("trainset", "car", "bogie", "axle", "operator", "comment")),
    ]
    return table(["what", "on record"], [[name, text] for name, text in rows if text], "ll")


def _temperatures(source: Source) -> str:
    assert source.header is not None
    return f"wheelset {source.header.temperature_c.wheelset:.2f} °C, rig {source.header.temperature_c.rig:.2f} °C"


def _measurements(source: Source) -> str:
    found = source.rows("measurements")
    if not found:
        return ""
    reference = next((r["reference_scan_id"] for r in found if r["reference_scan_id"]), None)
    text = f"Values at 20 °C; U = k u, k = {found[0]['coverage_factor']:g}. Reference: {escape(reference or 'none')}."
    return _section("Measurements", f"{text}\n\n{listing(MEASUREMENTS, found)}")


def _stages(source: Source) -> str:
    rows = []
    for name in (BUNDLE, *(s.name for s in SCAN_STAGES)):
        record = source.records.get(name)
        made = "; ".join(f"{o.table} {o.rows:,}" for o in record.outputs) if record else ""
        seconds = f"{record.seconds:.2f}" if record and record.seconds else ""
        rows.append([_stage(name), record.state if record else "not run", seconds, made])
    return _section("Stages", table(["stage", "state", "s", "rows"], rows, "llrl"))


def _calibration(source: Source) -> str:
    if source.header is None:
        return ""
    title, stored = f"Calibration {source.header.calibration_id}", source.calibrations
    if stored is None or not stored.num_rows:
        reason = source.calibration.reason if source.calibration else None
        return _section(title, f"No calibrated sensor: {escape(reason or 'it is not on record')}")
    found = stored.to_pylist()
    age_days = (source.header.captured_at - found[0]["captured_at"]).total_seconds() / 86400
    step_k = source.header.temperature_c.rig - found[0]["rig_temperature_c"]
    text = f"{age_days:.1f} days older than the scan, in which the rig was {step_k:+.2f} K from the calibration's. RMS in px."
    return _section(title, f"{text}\n\n{listing(CALIBRATIONS, found)}")


def _notes(source: Source) -> str:
    notes = list(dict.fromkeys(source.notes))
    if source.angle_deg is None:
        notes.append(
            "The turn's angles are not on record: clouds lie as the sensors saw them, all frames in one place."
        )
    return "\n".join(f"- {escape(note)}" for note in notes)


def _stage(name: str) -> str:
    return escape(STAGE_WORDS.get(name, name))


def _section(title: str, text: str) -> str:
    return f"## {title}\n\n{text}" if text else ""


def escape(text: str) -> str:
    """Text in which nothing means anything to Markdown; one line."""
    for sign in "\\|<*`[":
        text = text.replace(sign, "\\" + sign)
    return " ".join(text.split())


def listing(columns: tuple[Col, ...], rows: Iterable[dict[str, Any]]) -> str:
    """A Markdown table of stored rows, numbers to the right."""
    cells = [[_cell(row[c.name], c.form) for c in columns] for row in rows]
    return table([c.head for c in columns], cells, "".join("r" if c.form else "l" for c in columns))


def _cell(value: Any, form: str) -> str:
    if isinstance(value, list):
        return ", ".join(value) or NONE
    return NONE if value is None else format(value, form)


def table(heads: list[str], rows: list[list[str]], align: str) -> str:
    """A Markdown table; `align` has a letter for each column, l or r. Nothing if there is no row."""
    if not rows:
        return ""
    rule = "|".join("---:" if a == "r" else "---" for a in align)
    lines = [f"| {' | '.join(escape(cell) for cell in row)} |" for row in rows]
    return "\n".join([f"| {' | '.join(heads)} |", f"|{rule}|", *lines])
