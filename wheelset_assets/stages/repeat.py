"""Stage 8, between tables and arrays: repeatability of production measurements."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from wheelset_assets import tables
from wheelset_assets.config import RepeatabilityConfig
from wheelset_assets.metrology.repeatability import spreads

GROUP = ("wheelset_id", "quantity", "side")


def run_repeatability(*, measurements: pa.Table, config: RepeatabilityConfig) -> Mapping[str, pa.Table]:
    """Stage 8: spread of production values by wheelset, quantity and side, over each day, month and all time."""
    kept = measurements.filter(
        pc.and_(pc.equal(measurements["purpose"], "production"), pc.is_valid(measurements["value"]))
    )
    if kept.num_rows == 0:
        return {"repeatability": tables.REPEATABILITY.empty()}
    texts, codes = {}, {}
    for name in (*GROUP, "unit"):
        texts[name], codes[name] = _ranked(kept[name])
    day = kept["acquired_on"].to_numpy().astype("datetime64[D]")
    numbers = {n: kept[n].to_numpy() for n in ("value", "value_uncompensated", "expanded_uncertainty")}
    order = np.lexsort((numbers["value"], day, *(codes[n] for n in reversed(GROUP))))
    codes = {name: code[order] for name, code in codes.items()}
    day = day[order]
    numbers = {name: values[order] for name, values in numbers.items()}
    begins = _changes(*(codes[n] for n in GROUP))
    parts = []
    for period, also in (("day", day), ("month", day.astype("datetime64[M]")), ("all", None)):
        starts = np.flatnonzero(begins if also is None else begins | _changes(also))
        found = _statistics(numbers, starts)
        first = day if also is None else also.astype("datetime64[D]")
        columns: dict[str, Any] = {name: pa.array(texts[name]).take(pa.array(codes[name][starts])) for name in texts}
        columns |= {"period": [period] * len(starts), "period_start": first[starts], **found}
        part = tables.REPEATABILITY.from_columns(columns)
        parts.append(part.filter(pa.array(found["n"] >= config.min_values)))
    every = pa.concat_tables(parts)
    keys = [(name, "ascending") for name in (*GROUP, "period", "period_start")]
    return {"repeatability": every.sort_by(keys).combine_chunks()}


def _statistics(numbers: Mapping[str, np.ndarray], starts: np.ndarray) -> dict[str, Any]:
    compensated, bare = (spreads(numbers[name], starts) for name in ("value", "value_uncompensated"))
    u = numbers["expanded_uncertainty"]
    null_if_nan = lambda values: pa.array(values, from_pandas=True)  # noqa: E731
    return {
        "n": compensated.n,
        "mean": compensated.mean,
        "standard_deviation": null_if_nan(compensated.standard_deviation),
        "range": compensated.range,
        "minimum": compensated.minimum,
        "maximum": compensated.maximum,
        "standard_deviation_uncompensated": null_if_nan(bare.standard_deviation),
        "range_uncompensated": null_if_nan(bare.range),
        "mean_expanded_uncertainty": np.add.reduceat(u, starts) / compensated.n,
    }


def _ranked(column: pa.ChunkedArray) -> tuple[list[str], np.ndarray]:
    """Texts in order, and the place of each row's among them."""
    if not pa.types.is_dictionary(column.type):
        column = column.dictionary_encode()
    encoded = column.unify_dictionaries().combine_chunks()
    texts, place = np.unique(np.array(encoded.dictionary.to_pylist(), object), return_inverse=True)
    return texts.tolist(), place[encoded.indices.to_numpy()]


def _changes(*keys: np.ndarray) -> np.ndarray:
    """Where a row of sorted keys differs from the one before it; the first one does."""
    changed = np.zeros(len(keys[0]), bool)
    changed[0] = True
    for key in keys:
        changed[1:] |= key[1:] != key[:-1]
    return changed
