"""Spoilt bundles against the pipeline: a few hundred here, ten thousand by `python -m benchmarks.fuzz`."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # the checkout is where the benchmarks are run from

EXAMPLES, CHUNK = 300, 50
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pipes and alarms as POSIX has them")


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory):
    from benchmarks.fuzz import make_base

    made = make_base(tmp_path_factory.mktemp("fuzz"))
    measured = [value for value, _, flags in made.values.values() if value is not None and not flags]
    assert len(measured) > 30, "the good scan must give values, or nothing could go wrong with them"
    return made


@pytest.mark.parametrize("first", range(0, EXAMPLES, CHUNK))
def test_a_spoilt_bundle_is_refused_flagged_or_changes_nothing_that_counts(base, first):
    """The seeds are fixed: a generator that draws from the constants of whatever is imported gives others every time."""
    from benchmarks.fuzz import example

    problems = [v for v in (example(base, seed) for seed in range(first, first + CHUNK)) if v.problem]
    assert not problems, problems


def test_what_a_process_judges_by_survives_json():
    import json

    from benchmarks.fuzz import Base, kept, restored

    values = {("qr", "left"): (10.8, 0.03, frozenset({"outliers"})), ("rim_width", "left"): (None, None, frozenset())}
    base = Base(Path("there"), "S", values, {("qr", "left"): 10.79})
    assert restored(json.loads(json.dumps(kept(base))), Path("there")) == base


def test_a_value_that_is_wrong_without_a_flag_is_noticed():
    from benchmarks.fuzz import Base, _compare

    key = ("wheel_diameter", "left")
    good = Base(Path(), "S", {key: (920.0, 0.005, frozenset())}, {key: 920.004})
    for value, flags, outcome in (
        (920.0, (), "unchanged"),
        (920.004, (), "within U"),
        (920.0085, (), "U holds the truth"),
        (920.0105, (), "within U"),  # 2.1 U from the good value, 1.3 U from the truth
        (920.0120, (), "wrong"),
        (919.9945, (), "within U"),  # one of few may, by less than 1.5 U
        (919.992, (), "wrong"),
        (920.1, (), "wrong"),
        (920.1, ("sensor_moved",), "flagged"),
        (None, (), "values refused"),
    ):
        found = {key: (value, 0.005, frozenset(flags))}
        assert _compare(good, found)[0] == outcome
        assert (_compare(good, found)[1] is not None) == (outcome == "wrong")
