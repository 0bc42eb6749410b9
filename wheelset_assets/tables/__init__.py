"""Page 1: every stored table and column, with unit, meaning and limits. No code but declarations lives here."""

from __future__ import annotations

from wheelset_assets.tables.calibration import CALIBRATION_CORNERS, CALIBRATION_POSES, CALIBRATIONS
from wheelset_assets.tables.clouds import (
    FEATURES,
    FILTERED_CLOUDS,
    REMOVAL_REASONS,
    REMOVED_POINTS,
    STRIPE_STATISTICS,
    TRIANGULATED_CLOUDS,
)
from wheelset_assets.tables.columns import FLAGS
from wheelset_assets.tables.poses import ALIGNMENTS, FUSED_PROFILES, REGISTRATIONS
from wheelset_assets.tables.readings import (
    JOURNAL_SECTIONS,
    READINGS,
    ROUNDNESS_ORDERS,
    TREAD_MAPS,
    TURNS,
    WHEEL_FLATS,
    WHEEL_PROFILES,
)
from wheelset_assets.tables.values import BUDGETS, MEASUREMENTS, REPEATABILITY

__all__ = [
    "ALIGNMENTS",
    "ALL_TABLES",
    "BUDGETS",
    "CALIBRATIONS",
    "CALIBRATION_CORNERS",
    "CALIBRATION_POSES",
    "FEATURES",
    "FILTERED_CLOUDS",
    "FLAGS",
    "FUSED_PROFILES",
    "JOURNAL_SECTIONS",
    "MEASUREMENTS",
    "READINGS",
    "REGISTRATIONS",
    "REMOVAL_REASONS",
    "REMOVED_POINTS",
    "REPEATABILITY",
    "ROUNDNESS_ORDERS",
    "STRIPE_STATISTICS",
    "TABLES",
    "TREAD_MAPS",
    "TRIANGULATED_CLOUDS",
    "TURNS",
    "WHEEL_FLATS",
    "WHEEL_PROFILES",
]

ALL_TABLES = (
    CALIBRATIONS,
    CALIBRATION_POSES,
    CALIBRATION_CORNERS,
    TRIANGULATED_CLOUDS,
    STRIPE_STATISTICS,
    FILTERED_CLOUDS,
    REMOVED_POINTS,
    FEATURES,
    REGISTRATIONS,
    FUSED_PROFILES,
    ALIGNMENTS,
    READINGS,
    TURNS,
    ROUNDNESS_ORDERS,
    WHEEL_FLATS,
    JOURNAL_SECTIONS,
    WHEEL_PROFILES,
    TREAD_MAPS,
    MEASUREMENTS,
    BUDGETS,
    REPEATABILITY,
)
TABLES = {table.name: table for table in ALL_TABLES}
