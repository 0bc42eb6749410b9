"""How a cell and a column's head are written for people: decimals, signs, units, short words. No layout lives here."""

from __future__ import annotations

import datetime
import math
import re
from typing import Any

MISSING = "–"
UNITS = (
    ("_um_per_month", "µm/month", 3),
    ("_um_per_mm", "µm/mm", 4),
    ("_um_per_k", "µm/K", 2),
    ("_um", "µm", 2),
    ("_px", "px", 3),
    ("_mm", "mm", 4),
    ("_c", "°C", 1),
    ("_days", "days", 1),
    ("_months", "months", 1),
    ("_deg", "°", 3),
)
LONG = (
    "reason",
    "why",
    "quantities",
    "because",
    "outlook",
    "source",
    "recording",
    "details",
    "signals",
)
IN_THEIR_UNIT = (
    "value",
    "value_now",
    "value_in_a_week",
    "previous_value",
    "change",
    "change_per_month",
    "change_low_per_month",
    "change_high_per_month",
    "change_per_10000_km",
    "expanded_uncertainty",
    "expanded_uncertainty_in_a_week",
    "expanded_uncertainty_change",
    "limit_value",
    "limit_min",
    "limit_max",
    "margin",
    "mean",
    "center",
    "standard_deviation",
    "deviation",
    "tolerance",
    "old_value",
    "new_value",
    "old_expanded_uncertainty",
    "new_expanded_uncertainty",
    "mean_change",
    "max_change",
)
"""Columns of which each row says the unit in its column `unit`; four decimals suit mm, degrees and ratios alike."""
SIGNED = (
    "bias",
    "change",
    "correlation",
    "days_to_reference",
    "drift_high",
    "drift_low",
    "drift_um",
    "drift_uncompensated_um",
    "e_n",
    "error",
    "from_review",
    "lower_limit",
    "mean_e_n",
    "slope",
    "upper_limit",
)
WORDS = {
    "standard_deviation": "s.d.",
    "standard_error": "s.e.",
    "expanded_uncertainty": "U",
    "e_n": "E_n",
    "within_ratio": "|E_n|≤1",
    "days_to_reference": "days to review",
    "paper_ratio": "paper/ours",
    "u_reference": "u reference",
    "uncompensated": "uncomp.",
    "acquired_on": "day",
    "conform_probability": "probably conform",
    "beyond_now_probability": "beyond now",
    "beyond_in_a_week_probability": "beyond in a week",
    "expanded_uncertainty_in_a_week": "U in a week",
    "expanded_uncertainty_change": "U of change",
    "change_ratio": "|change|/U",
    "grr_percent": "GRR %",
}


def plain(value: Any) -> Any:
    """The value as JSON and CSV hold it: ISO times in UTC, null for what is no number."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, datetime.datetime):
        return (value.astimezone(datetime.UTC) if value.tzinfo else value).isoformat()
    if isinstance(value, datetime.date):
        return value.isoformat()
    return value


def unit(name: str) -> tuple[str, int]:
    """Unit and number of decimals of a column, from its name."""
    if name.startswith("n_"):
        return "", 0
    if name in IN_THEIR_UNIT:
        return "", 4
    for suffix, symbol, decimals in UNITS:
        if name.endswith(suffix):
            return symbol, decimals
    return "", 2


def label(name: str) -> tuple[str, str]:
    """Words and unit for the head of a column."""
    symbol, _ = unit(name)
    words = name
    for suffix, shown, _ in UNITS:
        if symbol and shown == symbol:
            words = name.removesuffix(suffix)
    for long, short in WORDS.items():
        words = re.sub(rf"(?<![a-z]){long}(?![a-z])", short, words)
    words = words.removeprefix("n_").removesuffix("_at").removesuffix("_id")
    return words.replace("_", " ").replace("E n", "E_n"), symbol


def text(name: str, value: Any) -> str:
    """The value as people read it, without its unit."""
    value = plain(value) if isinstance(value, float) else value
    if value is None:
        return MISSING
    if isinstance(value, datetime.datetime):
        moment = value.astimezone(datetime.UTC) if value.tzinfo else value
        return moment.strftime("%Y-%m-%d %H:%M")
    if isinstance(value, datetime.date):
        return value.strftime("%Y-%m") if name == "month" else value.isoformat()
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return _number(name, value)
    if name in ("verdict", "action"):
        return str(value).replace("_", " ")
    return "".join(letter if letter.isprintable() else " " for letter in str(value))


def _number(name: str, value: float) -> str:
    if name == "within_ratio":
        return f"{100 * value:.1f} %"
    if name.endswith("probability"):
        return "> 99.9 %" if value > 0.999 else "< 0.1 %" if value < 0.001 else f"{100 * value:.1f} %"
    if name.endswith("coverage_ratio"):
        return f"{100 * value:.1f} %"
    if name == "standard_uncertainty":  # of anything, in whichever unit
        return f"{value:.3g}"
    if name in ("change_ratio", "max_change_ratio"):
        return f"{value:.2f}"
    if name.endswith("_ratio"):
        return f"{value:.3g}×" if value < 1000 else f"{value:.0f}×"
    if name.endswith("_p"):
        return "< 0.0001" if value < 0.0001 else f"{value:.4f}"
    decimals = 3 if name.startswith("correlation") else unit(name)[1]
    signed = name.startswith(SIGNED) and "standard_error" not in name and not name.endswith("_limit_mm")
    shown = f"{value:+.{decimals}f}" if signed else f"{value:.{decimals}f}"
    return shown if float(shown) else shown.replace("-", "").replace("+", "")
