"""Round trips of the exchange formats, by an independent reader where one exists."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import pytest

from configs import PROFILES
from wheelset_assets.exchange import miniprof, qdas, simpack
from wheelset_assets.quality import ConfigError


def s1002() -> tuple[np.ndarray, np.ndarray]:
    return np.loadtxt(PROFILES / "S1002.csv", delimiter=",", skiprows=1).T


def test_miniprof_keeps_points_and_states_what_the_points_say() -> None:
    s, z = s1002()
    text = miniprof.write(miniprof.MiniProfProfile(s, z, {"WheelID": "W-7", "Sh": "99.0", "Side": "left"}))
    found = miniprof.read(text)
    assert np.max(np.abs(found.s_mm - s)) < 1e-6
    assert np.max(np.abs(found.z_mm - z)) < 1e-6
    assert found.header["WheelID"] == "W-7"
    assert float(found.header["Sh"]) == pytest.approx(28.0, abs=2e-3)  # of EN 13715: h 28, e 32.5, qR 10.794
    assert float(found.header["Sd"]) == pytest.approx(32.5, abs=2e-3)
    assert float(found.header["qR"]) == pytest.approx(10.794, abs=5e-3)
    assert miniprof.disagreements(found) == []


@pytest.mark.parametrize(("mirror", "flip"), [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_miniprof_reads_either_sign_of_both_axes(mirror: int, flip: int) -> None:
    s, z = s1002()
    lines = ["ColumnDef=X,Y,A", "", *(f"{mirror * a:.6f} {flip * b:.6f} 0" for a, b in zip(s, z, strict=True))]
    found = miniprof.read("\r\n".join(lines))
    assert np.max(np.abs(found.s_mm - s)) < 1e-6
    assert np.max(np.abs(found.z_mm - z)) < 1e-6


def test_a_copied_header_is_noticed() -> None:
    s, z = s1002()
    text = miniprof.write(miniprof.MiniProfProfile(s, z)).replace("Sd=32.5", "Sd=30.1")
    (told,) = miniprof.disagreements(miniprof.read(text))
    assert told.startswith("Sd: the header says 30.1")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("Sh=1\n", "no points"),
        ("ColumnDef=A,B\n\n1 2\n", "expected X and Y"),
        ("\n1 2\n3 x\n", "line 3"),
        ("\n1 2\n3 4\n", "needs three"),
    ],
)
def test_a_broken_file_says_where(text: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        miniprof.read(text, "w.whl")


def test_simpack_round_trip_with_units_mirror_and_inversion() -> None:
    s, z = s1002()
    text = simpack.write(s, z, "it's a 'test'")
    a, b = simpack.read(text)
    assert np.max(np.abs(a - s)) < 1e-6
    assert np.max(np.abs(b - z)) < 1e-6
    metres = text.replace("units.len.f    = 1000.0", "units.len.f    = 1.0")
    assert np.max(np.abs(simpack.read(metres)[0] - 1000 * s)) < 1e-2
    assert np.max(np.abs(simpack.read(text.replace("mirror.z       = 0", "mirror.z       = 1"))[1] + z)) < 1e-6
    with pytest.raises(ConfigError, match="no point"):
        simpack.read("nothing")


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_qdas_is_read_by_an_independent_reader(tmp_path: Path) -> None:
    aqdef = pytest.importorskip("aqdefreader")
    start = datetime.datetime(2025, 4, 25, 8, tzinfo=datetime.UTC)
    times = [start + datetime.timedelta(minutes=i) for i in range(3)]
    one = qdas.Characteristic(
        "wheel diameter left", "mm", [919.12345, 919.2, None], times, ["W1", "W2", "W3"], 830.0, None
    )
    two = qdas.Characteristic("qr left", "mm", [10.5, 10.6, 10.7], times, ["W1", "W2", "W3"], 6.5, 12.0)
    path = tmp_path / "v.dfq"
    path.write_text(qdas.write("CRH3", "wheelset", [one, two]), newline="")
    part = aqdef.read_dfq_file(str(path)).get_part(0)
    assert part.get_data("K1001") == "CRH3"
    first, second = part.get_characteristics()
    assert first.get_data("K2002") == "wheel diameter left"
    assert float(first.get_data("K2110")) == 830.0
    assert [float(m.value) for m in first.get_measurements()][:2] == [919.12345, 919.2]
    assert [int(m.attribute or 0) for m in first.get_measurements()] == [0, 0, 256]
    assert [float(m.value) for m in second.get_measurements()] == [10.5, 10.6, 10.7]
    assert str(first.get_measurements()[1].datetime) in ("2025-04-25 08:01:00", "25.04.2025/08:01:00")
