"""Stage 8, between tables and arrays: repeatability of production measurements."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from datetime import date

import pyarrow as pa
import pyarrow.compute

from wheelset_assets import tables
from wheelset_assets.config import RepeatabilityConfig
from wheelset_assets.metrology.repeatability import spread


def run_repeatability(*, measurements: pa.Table, config: RepeatabilityConfig) -> Mapping[str, pa.Table]:
    """Stage 8: spread of production values by wheelset, quantity and side, over each day, month and all time."""
    names = [
        "wheelset_id",
        "quantity",
        "side",
        "unit",
        "acquired_on",
        "value",
        "value_uncompensated",
        "expanded_uncertainty",
    ]
    kept = measurements.filter(
        pa.compute.and_(
            pa.compute.equal(measurements["purpose"], "production"), pa.compute.is_valid(measurements["value"])
        )
    )
    kept = kept.select(names).sort_by(
        [(n, "ascending") for n in ("wheelset_id", "quantity", "side", "acquired_on", "value")]
    )
    groups: dict[tuple[str, str, str, str, str, date], list[int]] = defaultdict(list)
    first: dict[tuple[str, str, str], date] = {}
    columns = {name: kept[name].to_pylist() for name in names[:5]}
    for i, (wheelset, quantity, side, unit, day) in enumerate(zip(*columns.values(), strict=True)):
        start = first.setdefault((wheelset, quantity, side), day)
        for period, begin in (("day", day), ("month", day.replace(day=1)), ("all", start)):
            groups[wheelset, quantity, side, unit, period, begin].append(i)
    value, raw, u = (kept[n].to_numpy() for n in ("value", "value_uncompensated", "expanded_uncertainty"))
    rows = []
    for (wheelset, quantity, side, unit, period, begin), index in groups.items():
        if len(index) < config.min_values:
            continue
        s, bare = spread(value[index]), spread(raw[index])
        rows.append(
            {
                "wheelset_id": wheelset,
                "quantity": quantity,
                "side": side,
                "period": period,
                "period_start": begin,
                "unit": unit,
                "n": s.n,
                "mean": s.mean,
                "standard_deviation": s.standard_deviation,
                "range": s.range,
                "minimum": s.minimum,
                "maximum": s.maximum,
                "standard_deviation_uncompensated": bare.standard_deviation,
                "range_uncompensated": bare.range,
                "mean_expanded_uncertainty": float(u[index].mean()),
            }
        )
    return {"repeatability": tables.REPEATABILITY.from_rows(rows)}
