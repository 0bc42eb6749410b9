"""Columns that several tables share."""

from __future__ import annotations

from wheelset_assets.declare import Column
from wheelset_assets.quality import flag_names

SCAN_ID = Column("scan_id", "string", "Scan bundle that the row comes from")
SENSOR_ID = Column("sensor_id", "category", "Stereo sensor of the rig")
STATION = Column("station", "string", "Station of the rig: one wheel's rim or one journal")
LINE = Column("line", "int8", "Laser line: 0 is the one of smaller u in the left image", minimum=0, maximum=1)
FRAME = Column("frame", "int32", "Frame of the scan, counted from 0", minimum=0)
ROW = Column("row", "int16", "Row of the left image", minimum=0)
FLAGS = Column("quality_flags", "strings", f"Conditions under which the value stands, among: {', '.join(flag_names())}")
QUANTITY = Column("quantity", "string", "Measured quantity, as defined in `wheelset describe quantities`")
SIDE = Column(
    "side", "string", "left, right, or both for a distance across the wheelset", values=("left", "right", "both")
)
CALIBRATION_ID = Column("calibration_id", "string", "Calibration bundle")
RIG_ID = Column("rig_id", "string", "Measuring rig")
