"""Page 2: every knob, one frozen model a stage. No default of any algorithm is written anywhere else.

A file given by `--config` overrides these defaults; an unknown key is an error. The fingerprint of a stage's section
decides what is recomputed when a knob is touched.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from wheelset_assets.quality import ConfigError


class Section(BaseModel):
    """Base of the sections: frozen, and strict about unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def fingerprint(self) -> str:
        """Sixteen hexadecimal digits that change when, and only when, a knob of this section changes."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


class CalibrationConfig(Section):
    """Stage 1: stereo calibration from board images."""

    min_poses: int = Field(5, ge=3, description="Fewer usable poses refuse the calibration")
    min_tilt_deg: float = Field(
        8.0,
        ge=0,
        description="If no board is tilted more than this, the calibration is refused: depth and focal length cannot be told apart",
    )
    max_pose_rms_ratio: float = Field(
        4.0, gt=1, description="A pose whose RMS exceeds this multiple of the median pose's is left out"
    )
    max_rms_px: float = Field(0.5, gt=0, description="A stereo RMS above this refuses the calibration")
    max_tilt_deg: float = Field(
        70.0, gt=0, le=90, description="A board turned farther from facing the camera is too oblique"
    )
    max_blur_ratio: float = Field(
        0.15, gt=0, description="A board whose edges are blurred over more than this share of a square is left out"
    )
    max_saturated_ratio: float = Field(
        0.6,
        gt=0,
        le=1,
        description="A larger share of full-scale pixels about the corners leaves the pose out; white squares alone make one half",
    )


class TriangulationConfig(Section):
    """Stage 2: from stripe centres to points."""

    method: Literal["least_squares", "disparity", "optimal"] = Field(
        "disparity",
        description="least_squares: eq. 8-10; disparity: eq. 11-13, the best point of one match; optimal: with the scan's own laser plane as a fifth row",
    )
    stripe_method: Literal["centroid", "parabola", "steger"] = Field(
        "centroid",
        description="Sub-pixel centre for raw images: centre of gravity under a weight as wide as the stripe, parabola through the logarithms, or Steger's ridge",
    )
    stripe_min_contrast: float = Field(12.0, gt=0, description="Smallest peak above background, grey levels of 255")
    stripe_window_px: int = Field(0, ge=0, description="Half window about the peak; 0 follows the stripe's width")
    max_step_px: float = Field(
        4.0, gt=0, description="A larger jump of the right stripe from row to row is a gap: no interpolation across it"
    )
    min_depth_mm: float = Field(20.0, gt=0, description="Points nearer to the camera are mismatches")
    max_depth_mm: float = Field(5000.0, gt=0, description="Points farther away are mismatches")
    mismatch_sigmas: float = Field(
        8.0,
        gt=2,
        description="A point farther off its laser plane than this multiple of its noise and the plane's scatter is a mismatch",
    )
    mismatch_floor_mm: float = Field(0.5, gt=0, description="Points nearer to their laser plane are never mismatches")
    out_of_step_sigmas: float = Field(
        6.0,
        gt=2,
        description="A frame whose points lie off the laser plane, all alike, by more than this multiple of their noise is left out",
    )
    out_of_step_floor_um: float = Field(
        5.0, gt=0, description="Frames nearer to their laser plane are never left out for it"
    )
    refuse_calibration_age_days: float = Field(
        730.0, gt=0, description="A scan this much later than its calibration is not triangulated"
    )


class FilteringConfig(Section):
    """Stage 3: which points are kept, and how they are smoothed and thinned."""

    range_margin_mm: float = Field(
        60.0, gt=0, description="Range gate: distance from the median depth of the sensor's scan"
    )
    outlier_sigmas: float = Field(
        5.0, gt=2, description="Hampel test along rows and along frames: multiple of the robust standard deviation"
    )
    outlier_window_rows: int = Field(11, ge=5, description="Window of the test along rows (odd)")
    min_cluster_rows: int = Field(6, ge=1, description="Shorter runs of rows between gaps are removed as isolated")
    smoothing: Literal["none", "median", "mean", "gaussian", "quadratic", "bilateral"] = Field(
        "quadratic",
        description="eq. 14, 15 or 16-17, a parabola with the Gaussian's weights, or edge-preserving, on the organised frame x row grid",
    )
    bilateral_um: float = Field(
        60.0, gt=0, description="Bilateral smoothing: neighbours that depart by more than this hardly count"
    )
    edge_mm: float = Field(
        0.3,
        gt=0,
        description="Mean and Gaussian: neighbours on both sides whose mean departs by more belong to another surface",
    )
    edge_sigmas: float = Field(
        6.0, ge=5, description="The same in standard uncertainties of a point's depth, where that is more than edge_mm"
    )
    window_rows: int = Field(7, ge=1, description="Smoothing window along rows (odd)")
    window_frames: int = Field(
        1, ge=1, description="Smoothing window along frames (odd); 1 leaves the frames independent"
    )
    gaussian_sigma_rows: float = Field(
        1.5, gt=0, description="Standard deviation of the Gaussian and of the parabola's weights, in rows"
    )
    max_rows: int = Field(512, ge=32, description="After smoothing, one of every round(n / max_rows) rows is kept")


class FeatureConfig(Section):
    """Stage 4: ISS keypoints and FPFH descriptors."""

    spacing_mm: float = Field(1.0, gt=0, description="Point spacing of the folded patch")
    patch_columns: int = Field(17, ge=5, description="Columns of the folded patch across the meridian")
    saliency_radius_mm: float = Field(4.0, gt=0, description="R of eq. 18")
    gamma_21: float = Field(0.975, gt=0, le=1, description="Largest ratio of second to first eigenvalue")
    gamma_32: float = Field(0.975, gt=0, le=1, description="Largest ratio of third to second eigenvalue")
    non_maximum_radius_mm: float = Field(3.0, gt=0, description="Radius in which only the most salient point is kept")
    normal_radius_mm: float = Field(3.0, gt=0, description="Radius for normals")
    descriptor_radius_mm: float = Field(6.0, gt=0, description="Radius for SPFH and FPFH")


class RegistrationConfig(Section):
    """Stage 5: sensors of one station into one frame."""

    nominal_translation_mm: float = Field(
        2.0, gt=0, description="Tolerance of a sensor's nominal place (scan-bundle format)"
    )
    nominal_rotation_deg: float = Field(1.0, gt=0, description="Tolerance of a sensor's nominal orientation")
    match_radius_mm: float = Field(
        8.0, gt=0, description="Keypoints farther apart than this at the nominal poses are not matched"
    )
    coarse_inlier_mm: float = Field(
        1.0, gt=0, description="A match within this distance of the coarse pose supports it"
    )
    coarse_trials: int = Field(200, ge=1, description="Random triples of matches tried for the coarse pose")
    seed: int = Field(20250405, description="Seed of those trials")
    max_iterations: int = Field(60, ge=1, description="Iterations of ICP")
    convergence_um: float = Field(0.01, gt=0, description="ICP ends when no point moves farther than this")
    max_pair_mm: float = Field(
        6.0, gt=0, description="Largest distance of an ICP pair at the start; it shrinks with the residuals"
    )
    min_pairs: int = Field(30, ge=6, description="Fewer pairs on the mean meridian: no registration")
    form_floor_um: float = Field(
        1.0, gt=0, description="Standard uncertainty of the profile's form that averaging does not lower"
    )
    constrained_ratio: float = Field(
        0.1,
        gt=0,
        lt=1,
        description="A direction is constrained if the data cut its prior uncertainty to less than this share",
    )
    frequency_limit_um: float = Field(
        100.0, gt=0, description="Frequency-domain check: a larger shift against the fine registration is flagged"
    )
    frequency_limit_deg: float = Field(0.15, gt=0, description="The same for the rotation in the meridian plane")


class AlignmentConfig(Section):
    """Stage 6: datum faces, and squaring to the axle."""

    tangent_threshold_deg: float = Field(
        3.0, gt=0, description="Eq. 27: largest angle between successive difference vectors on a face"
    )
    step_mm: float = Field(1.0, gt=0, description="Length of those difference vectors")
    max_tilt_deg: float = Field(
        4.0, gt=0, description="A face may deviate this far from square to the axle before squaring"
    )
    min_face_mm: float = Field(3.0, gt=0, description="Smallest radial extent of a face")
    min_journal_mm: float = Field(8.0, gt=0, description="Smallest length of a journal's cylinder")
    nominal_rotation_deg: float = Field(
        1.0, gt=0, description="Tolerance of a sensor's nominal orientation: the prior of the squaring"
    )
    flat_sigmas: float = Field(
        4.0,
        gt=1,
        description="Points farther from the face's line than this multiple of its scatter do not belong to it",
    )


class MeasurementConfig(Section):
    """Stage 7: quantities, temperature, uncertainty."""

    tangent_threshold_deg: float = Field(
        3.0, gt=0, description="As in [alignment]: the readings find the datum faces again in the reference's geometry"
    )
    step_mm: float = Field(1.0, gt=0, description="As in [alignment]")
    max_tilt_deg: float = Field(4.0, gt=0, description="As in [alignment]")
    min_face_mm: float = Field(3.0, gt=0, description="As in [alignment]")
    min_journal_mm: float = Field(8.0, gt=0, description="As in [alignment]")
    flat_sigmas: float = Field(4.0, gt=1, description="As in [alignment]")
    edge_margin_mm: float = Field(
        0.5, ge=0, description="Kept away from the ends of a face or cylinder, where fillets begin"
    )
    nominal_translation_mm: float = Field(
        2.0, gt=0, description="Tolerance of a sensor's nominal place, for the budget"
    )
    nominal_rotation_deg: float = Field(
        1.0, gt=0, description="Tolerance of a sensor's nominal orientation, for the budget"
    )
    datum_mm: float = Field(70.0, gt=0, description="L2: datum circle from the inner face")
    flank_height_mm: float = Field(
        10.0, gt=0, description="L3: height of the flange thickness above the tread at the datum"
    )
    tip_drop_mm: float = Field(2.0, gt=0, description="L1: depth of qR's upper point below the flange's top")
    tread_half_width_mm: float = Field(
        10.0, gt=0, description="Half width of the band about the datum circle that gives its radius"
    )
    runout_order: int = Field(6, ge=1, description="Harmonics of the turn that run-outs are evaluated from")
    spectrum_order: int = Field(
        30,
        ge=6,
        le=200,
        description="Harmonics of the tread's turn that roundness and polygon orders are evaluated from",
    )
    hollow_to_mm: float = Field(
        130.0, gt=80, description="Outer end of the band from the datum circle in which hollow wear is looked for"
    )
    journal_sections_mm: tuple[float, ...] = Field(
        (25.0, 95.0), min_length=2, description="Sections of a journal, counted from the shoulder, first to last"
    )
    section_half_width_mm: float = Field(5.0, gt=0, description="Half width of a journal's section")
    map_angle_bins: int = Field(180, ge=8, description="Bins of the turn of a wheel's deviation map")
    map_step_mm: float = Field(1.5, ge=0.25, description="Lateral bins of a wheel's deviation map")
    max_scatter_um: float = Field(
        200.0, gt=0, description="Frames that scatter more than this about their harmonics give no value"
    )
    uneven_floor_um: float = Field(
        4.0,
        gt=0,
        description="Frames that scatter about their harmonics by more than their own noise, and than this, flag an uneven turn",
    )
    min_coverage: float = Field(0.6, gt=0, le=1, description="Smallest share of the turn")
    max_gap_deg: float = Field(100.0, gt=0, description="Largest gap of the turn")
    min_frames: int = Field(8, ge=4, description="Fewer frames give no value")
    exclude_sigmas: float = Field(
        4.0,
        gt=2,
        description="Frames farther from the harmonics than this multiple of the robust scatter are dirt or flats",
    )
    outlier_flag_ratio: float = Field(0.1, gt=0, lt=1, description="A larger excluded share is flagged")
    thermometer_wheelset_u_c: float = Field(
        0.03, ge=0, description="Standard uncertainty of a wheelset thermometer reading"
    )
    thermometer_rig_u_c: float = Field(0.03, ge=0, description="Standard uncertainty of a rig thermometer reading")
    expansion_wheelset_u_per_k: float = Field(
        0.3e-6, ge=0, description="Standard uncertainty of the wheelset's expansion coefficient"
    )
    expansion_rig_u_per_k: float = Field(
        0.3e-6, ge=0, description="Standard uncertainty of the rig's expansion coefficient"
    )
    axis_u_um: float = Field(
        0.25,
        ge=0,
        description="Standard uncertainty of the axis of rotation in a scan, across one direction: a disc of radius 0.5 um",
    )
    max_reference_temperature_step_k: float = Field(
        5.0, gt=0, description="A larger change since the reference scan is flagged"
    )
    max_calibration_temperature_step_k: float = Field(
        12.0, gt=0, description="A larger distance from the calibration's temperature is flagged"
    )
    min_temperature_c: float = Field(-20.0, description="Colder scans are refused")
    max_temperature_c: float = Field(60.0, description="Warmer scans are refused")
    max_calibration_age_days: float = Field(180.0, gt=0, description="An older calibration is flagged")
    moved_sigmas: float = Field(
        6.0,
        gt=0,
        description="A station that differs from its reference scan by more than this multiple of its uncertainty is flagged as moved",
    )
    moved_floor_um: float = Field(15.0, gt=0, description="Smaller differences are never flagged as moved")
    epipolar_floor_px: float = Field(
        0.1,
        gt=0,
        description="Smaller changes of the epipolar residual since the reference scan are no sign of cameras that moved",
    )
    epipolar_calibration_px: float = Field(
        0.3,
        gt=0,
        description="Cameras moved since the calibration if the epipolar residual itself is larger; a good calibration leaves some hundredths",
    )
    max_out_of_step_ratio: float = Field(
        0.02,
        ge=0,
        lt=1,
        description="A larger share of frames whose two cameras saw different instants, or were damaged, flags the station",
    )
    max_frame_pull: float = Field(
        1.25,
        gt=1,
        description="Frames that scatter about their laser plane by more than this multiple of their noise flag the station",
    )
    frame_scatter_floor_um: float = Field(
        0.5,
        gt=0,
        description="Frames that scatter by less about their laser plane flag nothing, whatever their noise",
    )
    plane_floor_um: float = Field(
        8.0,
        gt=0,
        description="Smaller shifts of a laser plane since the reference scan, over its field, are the calibration's own imperfection seen at another depth",
    )


class RepeatabilityConfig(Section):
    """Stage 8: statistics of repeated measurements."""

    min_values: int = Field(1, ge=1, description="Periods with fewer values are left out")


class Config(Section):
    """All sections; the keys of a configuration file."""

    calibration: CalibrationConfig = CalibrationConfig()
    triangulation: TriangulationConfig = TriangulationConfig()
    filtering: FilteringConfig = FilteringConfig()
    features: FeatureConfig = FeatureConfig()
    registration: RegistrationConfig = RegistrationConfig()
    alignment: AlignmentConfig = AlignmentConfig()
    measurement: MeasurementConfig = MeasurementConfig()
    repeatability: RepeatabilityConfig = RepeatabilityConfig()


def load_config(path: Path | None) -> Config:
    """Configuration from a TOML file over the defaults; ConfigError names the file, the key and what was expected."""
    if path is None:
        return Config()
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not a TOML file: {error}") from error
    try:
        return Config.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ConfigError(
            f"{path}: {key}: {first['msg']} (got {first.get('input')!r}); `wheelset describe config` lists the keys"
        ) from error
