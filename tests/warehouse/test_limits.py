"""Limits as data, and the verdicts that the catalog draws from them."""

from __future__ import annotations

import shutil
from pathlib import Path

import duckdb
import numpy as np
import pytest
from fake_inbox import FakeStages, run_night
from scipy.stats import norm

from configs import LIMITS as SHIPPED
from warehouse import catalog, limits, report
from warehouse.lineage import Ledger
from wheelset_assets.quality import ConfigError

COLUMNS = """scan_id VARCHAR, wheelset_id VARCHAR, purpose VARCHAR, captured_at TIMESTAMPTZ, quantity VARCHAR, side VARCHAR,
    value DOUBLE, unit VARCHAR, expanded_uncertainty DOUBLE, coverage_factor DOUBLE, wheelset_type VARCHAR, trainset VARCHAR,
    car VARCHAR, bogie VARCHAR"""


def own(root: Path, text: str) -> Path:
    (root / "limits").mkdir(parents=True)
    (root / "limits" / "own.toml").write_text(text, encoding="utf-8")
    return root


def asked(root: Path, view: str, rows: list[tuple]) -> list[dict]:
    with duckdb.connect() as connection:
        connection.execute(f"CREATE TABLE measurements ({COLUMNS})")
        connection.executemany(f"INSERT INTO measurements VALUES ({', '.join('?' * 14)})", rows)
        connection.register("limits", limits.read_limits(root))
        connection.execute(report.functions())
        answer = connection.execute(report.query(f"limits/{view}.sql").text)
        return [dict(zip([d[0] for d in answer.description], row, strict=True)) for row in answer.fetchall()]


def row(
    quantity: str, value: float | None, u: float = 0.1, *, type_: str = "T", scan: str = "s1", side: str = "left", **of
):
    wheelset, bogie = of.get("wheelset", "w1"), of.get("bogie", "b1")
    return (
        scan,
        wheelset,
        "production",
        "2025-04-05 08:00:00+00",
        quantity,
        side,
        value,
        "mm",
        2 * u,
        2.0,
        type_,
        "t1",
        "c1",
        bogie,
    )


def test_the_shipped_files_are_whole_and_every_line_names_its_source(tmp_path: Path) -> None:
    table = limits.read_limits(tmp_path).to_pylist()
    assert {r["limit_set"] for r in table} == {"crh3", "standard-gauge"}
    assert all(r["source"] for r in table)
    assert {path.parent for path in limits.limit_files(tmp_path)} == {SHIPPED}


@pytest.mark.parametrize(
    ("value", "verdict"),
    [
        (10.0, "conform"),
        (9.81, "conform"),
        (9.79, "undecided"),
        (9.5, "undecided"),
        (8.75, "not_conform"),
        (20.3, "not_conform"),
    ],
)
def test_the_guard_band_is_the_expanded_uncertainty(tmp_path: Path, value: float, verdict: str) -> None:
    root = own(
        tmp_path,
        '[[limit]]\nquantity="q"\nlevel="operating"\nmin=9.6\nmax=20.0\nsource="s"\n'.replace("[[", 'name="n"\n[[', 1),
    )
    (found,) = asked(root, "verdicts", [row("q", value)])
    # 9.6 + U 0.2 = 9.8 is the smallest value that is conform; below 9.4 nothing is left to doubt
    assert found["verdict"] == verdict
    wanted = norm.cdf((20.0 - value) / 0.1) - norm.cdf((9.6 - value) / 0.1)
    assert found["p_conform"] == pytest.approx(wanted, abs=1e-12)
    assert found["margin"] == pytest.approx(min(value - 9.6, 20.0 - value))


def test_a_type_that_is_named_has_its_own_set_and_no_other(tmp_path: Path) -> None:
    text = 'name="n"\ntypes=["T"]\n[[limit]]\nquantity="q"\nlevel="planning"\nmax=1.0\nsource="s"\n'
    root = own(tmp_path, text)
    general = 'name="g"\n[[limit]]\nquantity="q"\nlevel="operating"\nmax=5.0\nsource="s"\n'
    (root / "limits" / "general.toml").write_text(general, encoding="utf-8")
    found = asked(root, "verdicts", [row("q", 0.0), row("q", 0.0, type_="other", scan="s2"), row("q", None, scan="s3")])
    assert {(r["scan_id"], r["limit_set"]) for r in found} == {("s1", "n"), ("s2", "g")}


def test_diameter_classes(tmp_path: Path) -> None:
    part = '[[limit]]\nquantity="q"\nlevel="operating"\nmax={}\nsource="s"\ndiameter_min_mm={}\ndiameter_max_mm={}\n'
    root = own(tmp_path, 'name="n"\n' + part.format(1, 760, 840) + part.format(2, 840, 1000))
    for diameter, wanted in ((800.0, 1.0), (840.0, 1.0), (920.0, 2.0)):
        (found,) = asked(root, "verdicts", [row("q", 0.0), row("wheel_diameter", diameter)])
        assert found["limit_max"] == wanted


def test_differences_within_bogie_car_and_trainset(tmp_path: Path) -> None:
    rows = [
        row("wheel_diameter", 920.0, scan="s1", wheelset="w1"),
        row("wheel_diameter", 921.0, scan="s2", wheelset="w2", side="right"),
        row("wheel_diameter", 915.0, 0.2, scan="s3", wheelset="w3", bogie="b2"),
        row("wheel_diameter", 915.5, scan="s4", wheelset="w4", bogie="b2"),
    ]
    text = 'name="n"\n[[limit]]\nquantity="wheel_diameter_difference_bogie"\nlevel="operating"\nmax=0.8\nsource="s"\n'
    found = asked(own(tmp_path, text), "diameter_differences", rows)
    by = {(r["quantity"].rsplit("_", 1)[1], r["bogie"]): r for r in found}
    assert by["bogie", "b1"]["value"] == pytest.approx(1.0)
    assert by["bogie", "b1"]["verdict"] == "undecided"
    assert by["bogie", "b2"]["value"] == pytest.approx(0.5)
    assert by["car", None]["value"] == by["trainset", None]["value"] == pytest.approx(6.0)
    assert by["car", None]["expanded_uncertainty"] == pytest.approx(np.hypot(0.2, 0.4))
    assert (by["car", None]["largest_wheelset"], by["car", None]["smallest_wheelset"]) == ("w2", "w3")
    assert by["car", None]["verdict"] is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('name="n"\n[[limit]]\nquantity="q"\nlevel="operating"\nsource="s"\n', "limit.0: min or max is needed"),
        (
            'name="n"\n[[limit]]\nquantity="q"\nlevel="operating"\nmin=2\nmax=1\nsource="s"\n',
            "min 2.0 is not below max 1.0",
        ),
        ('name="n"\n[[limit]]\nquantity="q"\nlevel="late"\nmin=2\nsource="s"\n', "limit.0.level"),
        ('name="n"\n[[limit]]\nquantity="q"\nlevel="operating"\nmin=2\n', "limit.0.source: Field required"),
        ('name="n"\n[[limit]]\nquantity="q"\nlevel="operating"\nmin=nan\nsource="s"\n', "limit.0.min"),
        ('name="n"\nkinds=[]\n', "kinds: Extra inputs"),
        ("name=", "not a TOML file"),
    ],
)
def test_a_wrong_file_is_named_with_key_and_expectation(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=r"own\.toml: ") as caught:
        limits.read_limits(own(tmp_path, text))
    assert message in str(caught.value)


def test_one_type_in_two_files_is_an_error(tmp_path: Path) -> None:
    root = own(tmp_path, 'name="n"\ntypes=["T"]\n')
    shutil.copy(root / "limits" / "own.toml", root / "limits" / "two.toml")
    with pytest.raises(ConfigError, match=r"'T' is also in own\.toml"):
        limits.read_limits(root)


def test_the_catalog_takes_edited_limits_and_survives_wrong_ones(
    inbox: Path, tmp_path: Path, stages: FakeStages
) -> None:
    root = tmp_path / "warehouse"
    run_night(inbox, root, None)
    catalog.build(root, Ledger(root))
    with catalog.connect(root) as connection:
        assert connection.execute("SELECT count(*) FROM limits").fetchone() != (0,)
        connection.execute("SELECT * FROM verdicts").fetchall()
    own(root, 'name="n"\n[[limit]]\nquantity="q"\nlevel="operating"\nmin=2\nsource="mine"\n')
    with catalog.connect(root) as connection:
        assert connection.execute("SELECT source FROM limits").fetchall() == [("mine",)]
    assert catalog.limit_troubles(root) == []
    (root / "limits" / "own.toml").write_text("name=", encoding="utf-8")
    with catalog.connect(root) as connection:
        assert connection.execute("SELECT count(*) FROM limits").fetchone() == (0,)
    (trouble,) = catalog.limit_troubles(root)
    assert "own.toml: not a TOML file" in trouble
