"""What the calibration report is made of. Its numbers are made in `sql/calibration`."""

from __future__ import annotations

from warehouse.report_declare import BlockSpec, FigureSpec, ReportSpec

CALIBRATION = ReportSpec(
    name="calibration",
    title="Calibration of the rigs",
    about=(
        "Each sensor's stereo calibration: how well it fits, how well it predicts poses that it did not use, what it "
        "covers, and since when it stands. Then what became of every board pose, and where the laser planes lie in the "
        "scans that were made with it: a plane that moved tells of a sensor that is no longer what was calibrated."
    ),
    main="sensors",
    order=("sensors", "refused", "intrinsics", "planes", "left_out", "board_poses", "residuals"),
    nothing="No calibration has been processed yet.",
    blocks=(
        BlockSpec(
            name="sensors",
            sql="calibration/sensors.sql",
            title="Sensors",
            says=(
                "Hold-out: RMS over poses, each under a fit that did not use it; well above the fit's own RMS it tells of "
                "too few poses. The lens model is the richest that does not predict worse than its rival."
            ),
            empty="No sensor is calibrated.",
            shown=(
                "calibration_id",
                "sensor_id",
                "state",
                "n_poses_used",
                "n_poses",
                "left_rms_px",
                "right_rms_px",
                "stereo_rms_px",
                "holdout_rms_px",
                "epipolar_rms_px",
                "baseline_mm",
                "u_baseline_um",
                "square_edge_error_um",
                "coverage_ratio",
                "right_coverage_ratio",
                "max_tilt_deg",
                "distortion_model",
                "age_days",
            ),
        ),
        BlockSpec(
            name="refused",
            sql="calibration/refused.sql",
            title="Calibrations that cannot be trusted",
            says="Scans that name one of these lose the sensor, or fail with this reason.",
            empty="Every sensor was calibrated.",
        ),
        BlockSpec(
            name="intrinsics",
            sql="calibration/intrinsics.sql",
            title="Parameters and their standard uncertainties",
            empty="No sensor is calibrated.",
            n_keys=3,
            limit=200,
        ),
        BlockSpec(
            name="planes",
            sql="calibration/planes.sql",
            title="Drift watch: laser planes and epipolar residuals by scan",
            says=(
                "Each plane is fitted to the scan's own points. Its shift is the distance from the plane of the first scan "
                "under the same calibration, at the middle of the points; its turn the angle between the normals. The "
                "epipolar residual is the vertical disparity between the two cameras, told by the stripes' slopes. `watch` "
                "names the flags that the scan's values carry, against its own reference scan."
            ),
            empty="No scan has been triangulated.",
            n_keys=3,
        ),
        BlockSpec(
            name="left_out",
            sql="calibration/left_out.sql",
            title="Poses left out",
            empty="Every pose was used.",
            n_keys=3,
        ),
        BlockSpec(
            name="board_poses",
            sql="calibration/poses.sql",
            title="Poses used",
            empty="No pose was used.",
            n_keys=3,
            limit=120,
        ),
        BlockSpec(
            name="residuals",
            sql="calibration/residuals.sql",
            title="Corners that are drawn",
            says="Of each rig's newest calibration; `calibration_corners` has every corner of every calibration.",
            empty="No corner is stored.",
            shown=("calibration_id", "sensor_id", "camera", "pose", "u_px", "v_px", "residual_u_px", "residual_v_px"),
            n_keys=4,
            limit=8,
        ),
    ),
    figures=(
        FigureSpec(
            name="residuals",
            kind="residuals",
            title="Residuals and poses of each rig's newest calibration",
            says=(
                "Vectors from the corners as found towards their projection. Vectors that point one way over a part of the "
                "image tell of a lens that the model does not follow; empty parts were not calibrated. Boards should stand "
                "nearer and farther, and tilted both little and much: focal length and depth come apart only then."
            ),
            legend=(
                ("point", "corners; board poses"),
                ("line", "residuals, enlarged"),
                ("band", "depth that corners cover"),
            ),
            after="board_poses",
        ),
    ),
)
