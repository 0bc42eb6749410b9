"""Every quantity that is measured: name, unit, definition with its source, the parameters it depends on, its support.

Nothing is computed here. What a program shows of a quantity, and in which order, derives from this page.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["zeroed", "absolute", "derived"]


@dataclass(frozen=True)
class Quantity:
    """One quantity.

    station: where it is read, or `wheelset` if it needs several stations. kind: zeroed by the master wheelset, absolute
    (within one station), or derived from other values. parameters: knobs of [measurement] that belong to its definition.
    support: what must be seen.
    """

    name: str
    station: Literal["wheel", "journal", "wheelset"]
    kind: Kind
    sides: tuple[str, ...]
    definition: str
    source: str
    support: str
    parameters: tuple[str, ...] = ()
    unit: str = "mm"


_EACH = ("left", "right")
_BOTH = ("both",)
_TURN = "inner face and tread over min_coverage of the turn without a gap beyond max_gap_deg"
_FACE = "inner face over min_coverage of the turn"
_FORMAT = "scan bundle format, Quantities"
_L = ("datum_mm",)

QUANTITIES: tuple[Quantity, ...] = (
    Quantity("journal_diameter", "journal", "zeroed", _EACH, "twice the mean radius over the turn and over the cylindrical part that was seen", _FORMAT, "cylinder of min_journal_mm over min_coverage of the turn", ("min_journal_mm",)),
    Quantity("wheel_diameter", "wheel", "zeroed", _EACH, "twice the mean radius (harmonic 0 over the turn, about the axis of rotation) on the circle datum_mm outward from the inner face of the same meridian; flats, dirt and outliers excluded", _FORMAT, _TURN, _L),
    Quantity("shoulder_distance", "wheelset", "zeroed", _BOTH, "between the two shoulders' flat faces, harmonic 0 over the turn of each", _FORMAT, "both shoulders over min_coverage of the turn"),
    Quantity("inner_distance", "wheelset", "zeroed", _BOTH, "between the two inner faces (back to back), harmonic 0 over the turn of each face's position on its flat part", _FORMAT, "both inner faces over min_coverage of the turn"),
    Quantity("flange_height", "wheel", "absolute", _EACH, "Sh: highest point of the mean meridian above the tread at the datum circle", _FORMAT + "; EN 13715 symbols", _TURN + "; flange's top", _L),
    Quantity("flange_thickness", "wheel", "absolute", _EACH, "Sd: lateral distance from the inner face to the flange's flank at flank_height_mm above the tread at the datum circle", _FORMAT, _TURN + "; flange's flank", ("datum_mm", "flank_height_mm")),
    Quantity("qr", "wheel", "absolute", _EACH, "qR: lateral distance between the flank's points flank_height_mm above the tread and tip_drop_mm below the flange's top", _FORMAT, _TURN + "; flange's flank", ("datum_mm", "flank_height_mm", "tip_drop_mm")),
    Quantity("radial_runout", "wheel", "absolute", _EACH, "largest less smallest radius on the datum circle over the turn about the axis of rotation, harmonics up to runout_order", _FORMAT, _TURN, ("datum_mm", "runout_order")),
    Quantity("axial_runout", "wheel", "absolute", _EACH, "largest less smallest position of the inner face over the turn about the axis of rotation, harmonics up to runout_order", _FORMAT, _FACE, ("runout_order",)),
    Quantity("wheel_diameter_tape", "wheel", "zeroed", _EACH, "perimeter of the datum circle over pi, as a tape gives it; harmonics up to spectrum_order", "domain practice: tape value", _TURN, ("datum_mm", "spectrum_order")),
    Quantity("wheel_diameter_difference", "wheelset", "derived", _BOTH, "absolute difference of the two wheel diameters of the axle", "axle limit of diameter differences", "both wheel diameters", _L),
    Quantity("rim_width", "wheel", "absolute", _EACH, "BR: between the inner and the outer face of the rim on their flat parts", "DIN 5573 (135 and 140 mm)", _FACE + "; outer face"),
    Quantity("rollover", "wheel", "absolute", _EACH, "metal beyond the plane of the rim's outer face; zero where there is none", "burr of BR", _FACE + "; outer face"),
    Quantity("tread_wear", "wheel", "absolute", _EACH, "flange height less that of the nominal profile: radial wear of the datum circle, aligned by inner face and flange's top", "wear at the datum circle, alignment by unworn surfaces", _TURN + "; flange's top; a nominal profile named by the bundle", _L),
    Quantity("tread_hollow", "wheel", "absolute", _EACH, "largest rise of the tread towards the field side between the datum circle and the chamfer, perpendicular to the axle: height of the false flange above the lowest tread point", "hollow wear (HO)", _TURN + "; tread outside the datum circle", ("datum_mm", "hollow_to_mm")),
    Quantity("out_of_roundness", "wheel", "absolute", _EACH, "largest less smallest radius on the datum circle about its own centre (order 1 removed), harmonics 2 to spectrum_order", "OOR about the least-squares centre", _TURN, ("datum_mm", "spectrum_order")),
    Quantity("flat_depth", "wheel", "absolute", _EACH, "depth of the deepest wheel flat, a chord of the tread; zero where none was found", "chord of the datum circle", _TURN, ("datum_mm", "exclude_sigmas")),
    Quantity("flat_length", "wheel", "absolute", _EACH, "length along the tread of the deepest wheel flat, 2 sqrt(D depth); zero where none was found", "chord of the datum circle", _TURN, ("datum_mm", "exclude_sigmas")),
    Quantity("radial_runout_journal_axis", "wheel", "derived", _EACH, "RR: as radial_runout, about the axis through the centres of the two journals", "EN 13260 practice: run-out about the journals", _TURN + "; both journals", ("datum_mm", "runout_order")),
    Quantity("axial_runout_journal_axis", "wheel", "derived", _EACH, "AX: as axial_runout, about the axis through the centres of the two journals", "EN 13260 practice: run-out about the journals", _FACE + "; both journals", ("runout_order",)),
    Quantity("inner_distance_0", "wheelset", "zeroed", _BOTH, "inner distance at the place of the turn that the encoder calls 0 degrees", "three places 120 degrees apart", "both inner faces over min_coverage of the turn", ("runout_order",)),
    Quantity("inner_distance_120", "wheelset", "zeroed", _BOTH, "inner distance 120 degrees farther", "three places 120 degrees apart", "both inner faces over min_coverage of the turn", ("runout_order",)),
    Quantity("inner_distance_240", "wheelset", "zeroed", _BOTH, "inner distance 240 degrees farther", "three places 120 degrees apart", "both inner faces over min_coverage of the turn", ("runout_order",)),
    Quantity("inner_distance_variation", "wheelset", "derived", _BOTH, "largest less smallest inner distance over the turn, harmonics up to runout_order", "spread of the three places, over the whole turn", "both inner faces over min_coverage of the turn", ("runout_order",)),
    Quantity("flange_front_distance", "wheelset", "derived", _BOTH, "SR: inner distance and both flange thicknesses (active faces, front to front)", "DIN 5573: SR = AR + 2 e", "inner distance and both flange thicknesses", ("datum_mm", "flank_height_mm")),
    Quantity("flange_back_distance", "wheelset", "derived", _EACH, "inner distance and one flange thickness: from the back of the other wheel to this wheel's active flange face", "check gauge", "inner distance and this flange thickness", ("datum_mm", "flank_height_mm")),
    Quantity("face_to_shoulder", "wheelset", "zeroed", _EACH, "from a wheel's inner face to the shoulder of its side, parallel to the axle", "AR1, AR2", "inner face and shoulder of one side; a certificate that names it"),
    Quantity("face_to_shoulder_difference", "wheelset", "derived", _BOTH, "face_to_shoulder left less right: how far the pair of wheels lies off the middle", "difference of AR1 and AR2", "face_to_shoulder of both sides"),
    Quantity("journal_diameter_inner", "journal", "zeroed", _EACH, "twice the mean radius over the turn of the first of journal_sections_mm, counted from the shoulder", "two sections a journal", "the section over min_coverage of the turn; the shoulder", ("journal_sections_mm", "section_half_width_mm")),
    Quantity("journal_diameter_outer", "journal", "zeroed", _EACH, "twice the mean radius over the turn of the last of journal_sections_mm, counted from the shoulder", "two sections a journal", "the section over min_coverage of the turn; the shoulder", ("journal_sections_mm", "section_half_width_mm")),
    Quantity("journal_taper", "journal", "absolute", _EACH, "journal_diameter_outer less journal_diameter_inner", "difference of the sections' means", "both sections", ("journal_sections_mm", "section_half_width_mm")),
    Quantity("journal_ovality", "journal", "absolute", _EACH, "largest less smallest diameter over the turn, even harmonics up to runout_order", "largest less smallest diameter of a section", "cylinder over min_coverage of the turn", ("runout_order",)),
    Quantity("journal_roundness", "journal", "absolute", _EACH, "largest less smallest radius about the journal's own centre, harmonics 2 to runout_order", "roundness about the least-squares centre", "cylinder over min_coverage of the turn", ("runout_order",)),
    Quantity("shoulder_squareness", "journal", "absolute", _EACH, "largest less smallest position of the shoulder's face over the turn, harmonic 1, on the circle where it was seen", "axial run-out of the shoulder", "shoulder over min_coverage of the turn"),
)  # fmt: skip
BY_NAME = {quantity.name: quantity for quantity in QUANTITIES}


def quantities_of(kinds: set[str]) -> list[tuple[str, str]]:
    """(quantity, side) that a rig with stations of these kinds is asked for, in the order of this page."""
    needs = {"wheel": {"wheel"}, "journal": {"journal"}}
    found = []
    for q in QUANTITIES:
        wanted = needs.get(q.station) or ({"journal"} if q.name == "shoulder_distance" else {"wheel"})
        if q.name.startswith("face_to_shoulder") or q.name.endswith("journal_axis"):
            wanted = {"wheel", "journal"}
        if wanted <= kinds:
            found += [(q.name, side) for side in q.sides]
    return found
