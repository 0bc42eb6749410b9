"""Quality flags and the three kinds of failure, sorted by what a person does next. Nothing else lives here."""

from __future__ import annotations

from enum import IntFlag


class WheelsetError(Exception):
    """Base of the failures that the pipeline knows; anything else that is raised is a bug."""


class ScanUnusable(WheelsetError):
    """The bundle itself cannot be used: scan again, or mend the file that the message names.

    `may_pass`: the cause may go without a change of its files (permissions): it is looked at every night.
    """

    may_pass: bool = False


class AlgorithmFailed(WheelsetError):
    """A stage could not do its work on good files: look at the recording. `facts` holds the figures that decided it."""

    def __init__(self, message: str, **facts: float | int | str) -> None:
        shown = ", ".join(
            f"{key} {value:.6g}" if isinstance(value, float) else f"{key} {value}" for key, value in facts.items()
        )
        super().__init__(f"{message} ({shown})" if shown else message)
        self.facts = facts


class ConfigError(WheelsetError):
    """The configuration, the command line or the inbox as a whole is wrong: nothing is run."""


class Flag(IntFlag):
    """One registry of quality flags; stored as lists of their names in lower case.

    A flag says that a value stands, but under a condition that its reader should know. What cannot stand at all is
    refused with a reason instead.
    """

    NONE = 0
    CALIBRATION_OLD = 1 << 0
    """The calibration is older than the configured limit (default 180 days)."""
    CALIBRATION_NOT_VALID = 1 << 1
    """The scan lies outside the calibration's own `valid_from` / `valid_until`."""
    CALIBRATION_FROM_THE_FUTURE = 1 << 2
    """The calibration was captured after the scan."""
    RIG_FAR_FROM_CALIBRATION_TEMPERATURE = 1 << 3
    """Rig temperature further from the calibration's than the limit (default 12 K)."""
    FAR_FROM_REFERENCE_TEMPERATURE = 1 << 4
    """Rig or wheelset temperature further from the reference scan's than the limit (default 5 K)."""
    REFERENCE_OF_ANOTHER_CALIBRATION = 1 << 5
    """The reference scan names another calibration; it was triangulated again with the scan's."""
    COVERAGE_GAP = 1 << 7
    """Part of the turn, or of the part of the profile that the value needs, was not seen."""
    OUTLIERS = 1 << 8
    """An unusual share of frames or points was excluded as dirt, flats or reflections."""
    SENSOR_MOVED = 1 << 9
    """The registration or the squareness of a station differs from the reference scan's by more than the scan explains."""
    COARSE_FROM_NOMINAL = 1 << 10
    """Too few consistent keypoint matches: the fine registration started from the nominal pose."""
    FEW_CONSTRAINTS = 1 << 11
    """The overlap constrains fewer than the three directions of the meridian plane."""
    SENSOR_MISSING = 1 << 12
    """A sensor of the station delivered nothing."""
    FRAMES_MISSING = 1 << 13
    """Frames of the encoder table have no stripe in a sensor that the value needs."""
    NO_REGISTRATION = 1 << 14
    """Sensors of one station could not be registered by their data; the nominal pose stands in."""
    NOT_DETECTED = 1 << 15
    """Nothing was found; the value is zero and its uncertainty says what could have escaped."""

    FREQUENCY_DISAGREES = 1 << 16
    """The frequency-domain check finds the registered sensors apart by more than its limits."""
    CAMERAS_MOVED = 1 << 17
    """The two cameras of a sensor no longer stand as calibrated, or as in the reference scan: the stripes' epipolar residual."""
    LASER_PLANE_MOVED = 1 << 18
    """A laser plane lies elsewhere than in the reference scan under the same calibration: a laser or a camera turned."""
    CAMERAS_OUT_OF_STEP = 1 << 19
    """A sensor's two cameras saw different instants in more frames than chance explains, or their frames were damaged."""
    UNEVEN_TURN = 1 << 20
    """Frames scatter about the turn's harmonics by more than their own noise: out of order, at wrong angles, or a fine shape."""

    FAR_FROM_NOMINAL = 1 << 21
    """A sensor's laser plane passes the axle farther away than its nominal pose and the rig's make allow."""

    def names(self) -> list[str]:
        """Lower-case names of the bits that are set, in the order of the registry."""
        return [flag.name.lower() for flag in type(self) if flag and flag in self and flag.name]


def flag_names() -> tuple[str, ...]:
    """Every name that a column `quality_flags` can hold."""
    return tuple(flag.name.lower() for flag in Flag if flag and flag.name)
