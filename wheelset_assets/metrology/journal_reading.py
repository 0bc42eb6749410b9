"""What a journal station reads: cylinder and its sections, shoulder, roundness, and where the journal's centre lies."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelset_assets.metrology.datum import Line, find_cylinder, find_face
from wheelset_assets.metrology.frame_series import FrameSeries, frame_series
from wheelset_assets.metrology.reading import (
    DatumSettings,
    Meridians,
    Reading,
    Section,
    StationReading,
    Turn,
    TurnSettings,
    described,
    face_series,
    jackknife,
    mean_at,
    over_the_turn,
    refuse,
    uneven,
    unsupported,
)
from wheelset_assets.metrology.revolution import HarmonicFit, MeridianGrid, fit_harmonics
from wheelset_assets.metrology.roundness import (
    Range,
    Spectrum,
    body_angle_deg,
    mean_direction_deg,
    peak_to_peak,
    spectrum,
)

Array = NDArray[Any]
Mask = NDArray[np.bool_]

CYLINDER_QUANTITIES = ("journal_diameter", "journal_lateral", "journal_ovality", "journal_roundness")
SECTION_QUANTITIES = ("journal_diameter_inner", "journal_diameter_outer", "journal_taper")
SHOULDER_QUANTITIES = ("shoulder_lateral", "shoulder_radial", "shoulder_squareness")
JOURNAL_READINGS = (*CYLINDER_QUANTITIES, *SECTION_QUANTITIES, *SHOULDER_QUANTITIES)


def journal_datum(meridians: Meridians, outward: float, s: DatumSettings) -> tuple[Line | None, Line | None]:
    """Cylinder and shoulder face of a journal; the shoulder is the face next to the cylinder's inboard end."""
    points = meridians.points
    cylinder = find_cylinder(
        points, meridians.straight(0.0, s), outward=outward, sigmas=s.flat_sigmas, min_length_mm=s.min_journal_mm
    )
    across = meridians.straight(90.0, s)
    if cylinder is not None:
        inboard_mm = cylinder.low_mm if outward > 0 else cylinder.high_mm
        across = across & ((points[:, 0] - inboard_mm) * outward < 0.5)
    face = find_face(points, across, outward, sigmas=s.flat_sigmas, min_length_mm=0.5 * s.min_face_mm)
    return cylinder, face


def read_journal(grids: list[MeridianGrid], angle_deg: Array, side: str, settings: TurnSettings) -> StationReading:
    """Readings of a journal station from its sensors' grids (frames, rows), in a geometry squared to the axle."""
    outward = 1.0 if side == "right" else -1.0
    body_deg = body_angle_deg(angle_deg, mean_direction_deg(g.direction_deg for g in grids))
    meridians = Meridians(grids, np.ones(len(angle_deg), bool))
    cylinder, face = journal_datum(meridians, outward, settings.datum)
    found = StationReading()
    shoulder_mm: float | None = None
    if face is None:
        found.readings.extend(refuse(SHOULDER_QUANTITIES, side, "the shoulder's face was not seen"))
    else:
        shoulder_mm = _shoulder(found, meridians, face, angle_deg, body_deg, side, settings)
    if cylinder is None:
        why = "the journal's cylinder was not seen"
        found.readings.extend(refuse((*CYLINDER_QUANTITIES, *SECTION_QUANTITIES), side, why))
    else:
        _cylinder(found, meridians, cylinder, angle_deg, body_deg, side, outward, shoulder_mm, settings)
    return found


def _shoulder(
    found: StationReading,
    meridians: Meridians,
    face: Line,
    angle_deg: Array,
    body_deg: Array,
    side: str,
    settings: TurnSettings,
) -> float | None:
    """Readings of the shoulder's face; its place along the axle, or None where the turn does not support it."""
    fit, series = face_series(meridians, face, angle_deg, settings)
    if (reason := unsupported(fit, settings)) or fit is None:
        found.readings.extend(refuse(SHOULDER_QUANTITIES, side, f"shoulder: {reason}"))
        return None
    mask = meridians.inside(face, 1, settings.datum.edge_margin_mm)
    level = mean_at(meridians.lateral, meridians.weight, mask)
    about = described(fit, series, settings, uneven(fit.scatter, fit.freedom, series, settings))
    turn = spectrum(body_deg, series.value_mm, fit.used, settings.runout_order, series.noise_mm)
    mean, u_mean = (turn.mean, turn.u_mean) if turn else (fit.mean, fit.u_mean)
    found.readings.extend(
        [
            Reading("shoulder_lateral", side, level + mean, u_mean, **about),
            Reading("shoulder_radial", side, mean_at(meridians.radial, meridians.weight, mask), **about),
        ]
    )
    if turn is None or turn.order < 1:
        found.readings.extend(refuse(("shoulder_squareness",), side, "shoulder: too few frames see it"))
    else:
        wobble = peak_to_peak(turn, 1, 1)
        found.readings.append(over_the_turn("shoulder_squareness", side, wobble, about))
        found.spectra["shoulder_lateral"] = turn
    found.turns.append(Turn("shoulder_lateral", level + series.value_mm, fit.used, level + fit.fitted))
    return level + mean


def _cylinder(
    found: StationReading,
    meridians: Meridians,
    cylinder: Line,
    angle_deg: Array,
    body_deg: Array,
    side: str,
    outward: float,
    shoulder_mm: float | None,
    settings: TurnSettings,
) -> None:
    mask = meridians.inside(cylinder, 0, settings.datum.edge_margin_mm)
    turn = _turn(meridians, mask, angle_deg, body_deg, settings)
    if isinstance(turn, str):
        found.readings.extend(refuse((*CYLINDER_QUANTITIES, *SECTION_QUANTITIES), side, f"journal: {turn}"))
        return
    series, fit, harmonics = turn
    about = described(fit, series, settings, uneven(fit.scatter, fit.freedom, series, settings))
    level = mean_at(meridians.radial, meridians.weight, mask)
    ovality, roundness = _oval(harmonics), peak_to_peak(harmonics, 2)
    more = [
        Reading("journal_diameter", side, 2 * (level + harmonics.mean), 2 * harmonics.u_mean, **about),
        Reading("journal_lateral", side, mean_at(meridians.lateral, meridians.weight, mask), **about),
    ]
    found.readings.extend(more)
    if harmonics.order < 2:
        why = f"the frames tell harmonics to order {harmonics.order} only, 2 are needed"
        found.readings.extend(refuse(("journal_ovality", "journal_roundness"), side, why))
    else:
        found.readings.append(over_the_turn("journal_ovality", side, ovality, about))
        found.readings.append(over_the_turn("journal_roundness", side, roundness, about))
    found.turns.append(Turn("journal_radius", level + series.value_mm, fit.used, level + fit.fitted))
    found.spectra["journal_radius"] = harmonics
    if shoulder_mm is None:
        why = "the sections count from the shoulder, which was not seen"
        found.readings.extend(refuse(SECTION_QUANTITIES, side, why))
        return
    _sections(found, meridians, mask, angle_deg, body_deg, side, outward, shoulder_mm, settings, about)


def _turn(
    meridians: Meridians, mask: Mask, angle_deg: Array, body_deg: Array, settings: TurnSettings
) -> tuple[FrameSeries, HarmonicFit, Spectrum] | str:
    """Radius of the masked rows frame by frame against their mean meridian, robust fit and harmonics; or why not."""
    series = frame_series(meridians, mask, "radial_mm", [m.radial_mm for m in meridians.means], angle_deg)
    fit = fit_harmonics(angle_deg, series.value_mm, settings.runout_order, settings.exclude_sigmas)
    if (reason := unsupported(fit, settings)) or fit is None:
        return reason or "too few frames see it"
    harmonics = spectrum(body_deg, series.value_mm, fit.used, settings.runout_order, series.noise_mm)
    return (series, fit, harmonics) if harmonics else "too few frames see it"


def _oval(harmonics: Spectrum) -> Range:
    """Largest less smallest diameter of a section: twice the range of the even harmonics' radius."""
    half = peak_to_peak(harmonics, 2, even=True)
    return Range(2 * half.value, 2 * half.u)


def _sections(
    found: StationReading,
    meridians: Meridians,
    cylinder: Mask,
    angle_deg: Array,
    body_deg: Array,
    side: str,
    outward: float,
    shoulder_mm: float,
    settings: TurnSettings,
    about: dict,
) -> None:
    """Mean diameter, ovality and roundness of each declared section, and the taper between the first and the last."""
    place = (meridians.lateral - shoulder_mm) * outward
    groups = meridians.left_out()
    means: dict[float, tuple[Section, Array] | str] = {}
    for at in settings.journal_sections_mm:
        rows = cylinder & (np.abs(place - at) <= settings.section_half_width_mm)
        if rows.sum() < 3 or not (place[rows].min() < at < place[rows].max()):
            means[at] = f"the section {at:g} mm from the shoulder was not seen"
            continue
        turn = _turn(meridians, rows, angle_deg, body_deg, settings)
        if isinstance(turn, str):
            means[at] = f"section {at:g} mm from the shoulder: {turn}"
            continue
        harmonics = turn[2]
        ovality, roundness = _oval(harmonics), peak_to_peak(harmonics, 2)
        level = mean_at(meridians.radial, meridians.weight, rows)
        left_out = np.array([2 * mean_at(r, meridians.weight, rows) for _, r in groups])
        section = Section(
            at,
            2 * (level + harmonics.mean),
            2 * harmonics.u_mean,
            ovality.value,
            ovality.u,
            roundness.value,
            roundness.u,
        )
        means[at] = section, left_out
        found.sections.append(section)
    first, last = (means[at] for at in (settings.journal_sections_mm[0], settings.journal_sections_mm[-1]))
    for name, one in (("journal_diameter_inner", first), ("journal_diameter_outer", last)):
        if isinstance(one, str):
            found.readings.extend(refuse((name,), side, one))
        else:
            found.readings.append(Reading(name, side, one[0].diameter_mm, one[0].u_diameter_mm, **about))
    if isinstance(first, str) or isinstance(last, str):
        found.readings.extend(refuse(("journal_taper",), side, first if isinstance(first, str) else str(last)))
        return
    taper = last[0].diameter_mm - first[0].diameter_mm
    u = max(jackknife(last[1] - first[1]), 1e-6)
    found.readings.append(Reading("journal_taper", side, taper, u, **about))
