"""The plan of a simulated campaign: every knob, checked, with its names and dates. `campaign` carries it out."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date, datetime, time, timedelta, timezone
from pathlib import Path
from types import MappingProxyType

from .noise import NoiseModel
from .presets import PRESETS
from .profiles import PROFILES

# Expanded uncertainties (k = 2) of a good certificate and of a review on a large CMM.
CERTIFICATE_U_MM: Mapping[str, float] = MappingProxyType(
    {
        "inner_distance": 0.003,
        "shoulder_distance": 0.003,
        "face_to_shoulder": 0.003,
        "wheel_diameter": 0.003,
        "journal_diameter": 0.0008,
    }
)
CMM_U_MM: Mapping[str, float] = MappingProxyType(
    {"inner_distance": 0.002, "shoulder_distance": 0.002, "wheel_diameter": 0.002, "journal_diameter": 0.0008}
)
LEAST = {"wheelsets": 0, "days": 1, "repeats": 0, "frames": 8, "rows": 128, "board_poses": 3}


@dataclass(frozen=True)
class Defects:
    """What a campaign's production wheelsets have beside ordinary wear and run-out; all nothing by default."""

    flat_length_mm: float = 0.0  # a chord's flat on each left tread
    polygon_order: int = 20
    polygon_um: float = 0.0  # amplitude of that order of the tread radius, both wheels
    journal_taper_um: float = 0.0  # outer minus inner diameter, both journals


@dataclass(frozen=True)
class SimulationPlan:
    """Everything that a campaign depends on: the same plan and seed write the same bytes.

    `days` campaign days, the first on `first_day`, spread evenly over `span_days` (default: consecutive days); on each
    a reference scan, then every wheelset `repeats` times. `rows`: image rows of the rig's tallest sensor; all image
    sizes follow. `profile`: a name of PROFILES or of `custom_profiles` ({name: (s_mm, z_mm)}), or several in turn.
    `rig`: a preset's name. `faults`: kinds of FAULTS, each spoils one of the campaign's last production scans.

    Several rigs may share an inbox: `name` becomes the rig's id and marks all identifiers and files of its campaign.
    Give the campaigns one `wheelset_seed` and they measure the same wheelsets and master, whose ids stay unmarked.
    """

    out: Path
    wheelsets: int = 1
    days: int = 1
    repeats: int = 2
    seed: int = 0
    images: bool = False
    faults: tuple[str, ...] = ()
    frames: int = 120
    rows: int = 1024
    profile: str | tuple[str, ...] = "S1002"
    custom_profiles: Mapping[str, tuple[Sequence[float], Sequence[float]]] = field(default_factory=dict)
    rig: str = "bench"
    name: str = ""
    wheelset_seed: int | None = None
    first_day: date = date(2025, 4, 5)
    span_days: int | None = None
    start_hour: int = 8
    utc_offset_hours: float = 8.0
    rig_temperature_c: tuple[float, float] = (18.0, 28.0)
    scan_difference_c: float = 3.0  # largest difference of rig and wheelset from the day's reference scan
    rig_expansion_per_k: float = 11.5e-6
    wheelset_expansion_per_k: float = 11.5e-6  # written into scan.json where it is not the format's default
    noise: NoiseModel = field(default_factory=NoiseModel)
    defects: Defects = field(default_factory=Defects)
    certificate_expanded_uncertainty_mm: Mapping[str, float] = field(default_factory=lambda: CERTIFICATE_U_MM)
    certificate_error_scale: float = 1.0  # actual errors: scale * U / 2 * N(0, 1)
    cmm_expanded_uncertainty_mm: Mapping[str, float] = field(default_factory=lambda: CMM_U_MM)
    cmm_error_scale: float = 1.0
    shift_mm: float = 1.0
    axis_error_um: float = 0.5
    board_poses: int = 12
    wheelset_prefix: str = "WS-"
    master_id: str = "MASTER-1"
    wheelset_type: str = "CRH3"
    stripe_sigma_px: float = 1.6  # width of the laser line in images

    def __post_init__(self) -> None:
        object.__setattr__(self, "out", Path(self.out))
        object.__setattr__(self, "faults", tuple(self.faults))
        for knob, least in LEAST.items():
            if getattr(self, knob) < least:
                raise ValueError(f"plan: {knob} is at least {least}, got {getattr(self, knob)}")
        known = {*PROFILES, *self.custom_profiles}
        if not self.profiles or not set(self.profiles) <= known:
            raise ValueError(f"plan: profile is one of {sorted(known)} or several of them, got {self.profile!r}")
        if self.rig not in PRESETS:
            raise ValueError(f"plan: rig is one of {sorted(PRESETS)}, got {self.rig!r}")
        if not re.fullmatch(r"([A-Za-z0-9][A-Za-z0-9._-]{0,31})?", self.name):
            raise ValueError(f"plan: name is at most 32 letters, digits, '.', '_' or '-', got {self.name!r}")
        if len(self.faults) > self.wheelsets * self.days * self.repeats:
            raise ValueError(f"plan: {len(self.faults)} faults need as many production scans; raise repeats or days")

    @property
    def profiles(self) -> tuple[str, ...]:
        """Profiles that the wheelsets take in turn; the master has the first."""
        return (self.profile,) if isinstance(self.profile, str) else tuple(self.profile)

    @property
    def rig_id(self) -> str:
        """Identifier of the rig."""
        return self.name or f"{self.rig}-1"

    @property
    def mark(self) -> str:
        """What precedes the campaign's identifiers: nothing, or its name and a hyphen."""
        return f"{self.name}-" if self.name else ""

    @property
    def artefact_mark(self) -> str:
        """What precedes the ids of wheelsets and master: nothing where campaigns share them."""
        return self.mark if self.wheelset_seed is None else ""

    @property
    def artefact_seed(self) -> int:
        """Seed of wheelsets, master and their certificates."""
        return self.seed if self.wheelset_seed is None else self.wheelset_seed

    def wheelset_label(self, index: int) -> str:
        """Name of a production wheelset within the campaign."""
        return f"{self.wheelset_prefix}{index:03d}"

    def day(self, index: int) -> date:
        """Date of a campaign day."""
        return self.first_day + timedelta(days=index * (self.span_days or self.days) // self.days)

    def at(self, day: date, minutes: float) -> datetime:
        """A time of day, minutes after the start hour, in the plan's own offset."""
        zone = timezone(timedelta(hours=self.utc_offset_hours))
        return datetime.combine(day, time(self.start_hour), zone) + timedelta(minutes=round(minutes))
