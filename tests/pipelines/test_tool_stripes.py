"""`wheelset tool stripes`: any images, both axes, bit depths, colours; what is found and what is refused."""

from __future__ import annotations

import csv
import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from pipelines.cli import app
from wheelset_assets.quality import ConfigError

ROWS, COLUMNS = 240, 320
CENTRE = 120 + 0.15 * np.arange(ROWS) + 12 * np.sin(np.arange(ROWS) / 40)


def stripes(*arguments):
    command = ["tool", "stripes", *map(str, arguments)]
    return CliRunner().invoke(app, command, catch_exceptions=False, standalone_mode=False)


def drawn(full=255, peak=0.6, sigma=1.8):
    """A Gaussian stripe along the rows on uneven ground, with noise of 1/128 of full scale."""
    v, u = np.mgrid[0:ROWS, 0:COLUMNS]
    ground = 0.08 + 0.1 * u / COLUMNS + 0.05 * np.cos(v / 60)
    grey = ground + peak * np.exp(-0.5 * ((u - CENTRE[:, None]) / sigma) ** 2)
    grey = grey + np.random.default_rng(1).normal(0, 1 / 128, grey.shape)
    return np.clip(np.rint(full * grey), 0, full)


def errors(found):
    row = np.array([c["row"] for c in found["centres"]])
    return np.array([c["column"] for c in found["centres"]]) - CENTRE[row]


@pytest.mark.parametrize(
    ("name", "image"),
    [
        ("grey.png", drawn().astype(np.uint8)),
        ("colour.bmp", np.repeat(drawn().astype(np.uint8)[..., None], 3, axis=2)),
        ("deep.tif", drawn(65535).astype(np.uint16)),
        ("twelve.png", drawn(4095).astype(np.uint16)),
        ("saturated.png", drawn(peak=4.0).astype(np.uint8)),
    ],
)
@pytest.mark.parametrize("method", ["centroid", "parabola", "steger"])
def test_centres_of_any_image(tmp_path, name, image, method):
    cv2.imwrite(str(tmp_path / name), image)
    done = stripes(tmp_path / name, "--method", method, "--json")
    assert done.return_value == 0
    (found,) = json.loads(done.stdout)
    assert found["file"] == str(tmp_path / name)
    assert len(found["centres"]) >= (0.9 if method == "steger" else 0.99) * ROWS
    error = errors(found)
    assert np.abs(error).max() < 0.15
    assert abs(error.mean()) < 0.01
    sigma = np.array([c["sigma_px"] for c in found["centres"]])
    # Steger's method bends with the stripe by what its smoothing takes off; the claim counts that to first order.
    low, high = (0.6, 1.7) if method == "steger" else (0.8, 1.2)
    assert low < (error / sigma).std() < high
    assert all(c["saturated"] == (name == "saturated.png") for c in found["centres"])
    assert {"width_px", "peak", "row", "column"} <= set(found["centres"][0])


def test_columns_are_rows_of_the_turned_image(tmp_path):
    image = drawn().astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    cv2.imwrite(str(tmp_path / "b.png"), image.T)
    rows = json.loads(stripes(tmp_path / "a.png", "--json").stdout)[0]["centres"]
    columns = json.loads(stripes(tmp_path / "b.png", "--axis", "columns", "--json").stdout)[0]["centres"]
    assert [(c["column"], c["row"]) for c in rows] == [(c["row"], c["column"]) for c in columns]


def test_several_images_text_and_csv(tmp_path):
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), drawn().astype(np.uint8))
    done = stripes(tmp_path / "a.png", tmp_path / "b.png", "--out", tmp_path / "c.csv")
    assert done.return_value == 0
    assert f"{ROWS} of {ROWS}" in done.stdout
    with (tmp_path / "c.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * ROWS


def test_an_image_without_a_stripe_says_why(tmp_path):
    cv2.imwrite(str(tmp_path / "dark.png"), np.full((64, 64), 20, np.uint8))
    done = stripes(tmp_path / "dark.png", "--json")
    assert done.return_value == 0
    (found,) = json.loads(done.stdout)
    assert found["centres"] == []
    assert "--min-contrast" in found["reason"]
    assert "dark.png: no stripe" in done.stderr


def test_files_that_cannot_be_read_are_named(tmp_path):
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(ConfigError, match=r"text\.png: not an image"):
        stripes(tmp_path / "text.png")
    with pytest.raises(ConfigError, match=r"none\.png: there is no such file"):
        stripes(tmp_path / "none.png")
