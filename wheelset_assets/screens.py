"""Screens of the tables' own checks: whether a check's SQL would select nothing, told from the columns in microseconds.

Each repeats its check on the safe side: where it is in doubt it says no, and the SQL is run.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa


def _known(table: pa.Table, name: str) -> np.ndarray:
    """Which rows have a value in a column."""
    return np.asarray(table[name].is_valid().to_numpy())


def value_or_reason(table: pa.Table) -> bool:
    """Whether every row has either a value or a reason."""
    return bool((_known(table, "value") != _known(table, "reason")).all())


def value_with_uncertainty(table: pa.Table) -> bool:
    """Whether every value has an uncertainty above zero."""
    known = _known(table, "value")
    uncertainty = table["expanded_uncertainty"].to_numpy()[known]  # NaN where there is none
    return bool((uncertainty > 0).all())


def shares_sum_to_one(table: pa.Table) -> bool:
    """Whether the shares of every scan, quantity and side sum to one; half the check's tolerance is left to rounding."""
    group = np.zeros(table.num_rows, np.int64)
    for name in ("scan_id", "quantity", "side"):
        column = table[name].combine_chunks()
        if not pa.types.is_dictionary(column.type):
            column = column.dictionary_encode()
        if column.null_count:
            return False
        codes = column.indices.to_numpy()
        group = np.unique(group * (len(column.dictionary) + 1) + codes, return_inverse=True)[1]
    shares = table["share"].to_numpy()
    if table["share"].null_count or not len(shares):
        return not len(shares)
    return bool((np.abs(np.bincount(group, weights=shares) - 1.0) <= 0.5e-6).all())
