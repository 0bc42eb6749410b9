"""Noise has the declared statistics, neither more nor less; images hold their lines where they should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from wheelset_assets.simulation.images import render_frames
from wheelset_assets.simulation.noise import NoiseModel, add_noise, correlated, encoder_error_deg
from wheelset_assets.simulation.streams import PURPOSES, in_ball, stream
from wheelset_assets.simulation.stripes import Stripes

SHAPE = (200, 1000)
NONE = NoiseModel.none()


def perfect(shape=SHAPE):
    u = np.broadcast_to(250.0 + 20.0 * np.sin(np.arange(shape[1]) / 90.0), shape)
    return Stripes(u.copy(), u.copy() + 3.0)


def spread_is(values, sigma, n_eff=None):
    """Two-sided 99.9 % interval of the sample variance."""
    n = n_eff or values.size
    low, high = chi2.ppf([0.0005, 0.9995], n - 1) / (n - 1)
    return low < values.var() / sigma**2 < high


def test_no_noise_changes_nothing():
    stripes = perfect()
    noisy = add_noise(stripes, NONE, 512, stream(1, "stripe"))
    assert np.array_equal(noisy.left_u, stripes.left_u)
    assert np.array_equal(noisy.right_u, stripes.right_u)


def test_white_noise_has_its_sigma_and_no_neighbours():
    stripes = perfect()
    model = replace(NONE, white_px=0.06)
    noisy = add_noise(stripes, model, 512, stream(1, "stripe"))
    left, right = noisy.left_u - stripes.left_u, noisy.right_u - stripes.right_u
    assert spread_is(left, 0.06)
    assert spread_is(right, 0.06)
    for a, b in ((left[:, 1:], left[:, :-1]), (left[1:], left[:-1]), (left, right)):
        assert abs((a * b).mean() / 0.06**2) < 4 / np.sqrt(a.size)


@pytest.mark.parametrize("length", [1.5, 3.0, 8.0])
def test_speckle_is_correlated_along_rows_as_declared(length):
    x = correlated(stream(2, "stripe"), (400, 2000), length)
    n_eff = x.size / (length * np.sqrt(np.pi))  # sum of squared correlations over all lags
    assert spread_is(x, 1.0, n_eff)
    for lag in (1, int(2 * length), int(6 * length)):
        expected = np.exp(-(lag**2) / (2 * length**2))
        assert (x[:, lag:] * x[:, :-lag]).mean() == pytest.approx(expected, abs=5 / np.sqrt(n_eff))
    assert abs((x[1:] * x[:-1]).mean()) < 5 / np.sqrt(n_eff)


def test_outliers_dropouts_and_gaps_have_their_shares():
    stripes = perfect()
    outliers = add_noise(stripes, replace(NONE, outlier_share=0.01), 512, stream(3, "stripe"))
    struck = outliers.left_u != stripes.left_u
    n = struck.size
    assert abs(struck.sum() - 0.01 * n) < 4 * np.sqrt(0.01 * n)
    assert (outliers.left_u[struck] < 0).any()
    assert (outliers.left_u[struck] > 512).any()
    dropped = np.isnan(add_noise(stripes, replace(NONE, dropout_share=0.02), 512, stream(3, "stripe")).right_u)
    assert abs(dropped.sum() - 0.02 * n) < 4 * np.sqrt(0.02 * n)
    gapped = add_noise(stripes, replace(NONE, gaps_per_frame=0.5, gap_rows=10), 512, stream(3, "stripe"))
    lost = np.isnan(gapped.left_u)
    assert np.array_equal(lost, np.isnan(gapped.right_u))
    assert 0.5 * 0.5 * 10 / 1000 < lost.mean() < 1.5 * 0.5 * 10 / 1000


def test_encoder_errors_keep_the_order_and_the_size():
    angle = np.arange(1000) * 0.36
    model = NoiseModel(encoder_deg=0.01, encoder_periodic_deg=0.02)
    error = encoder_error_deg(angle, model, stream(4, "encoder"))
    assert np.all(np.diff(angle + error) > 0)
    assert error.var() == pytest.approx(0.01**2 + 0.02**2 / 2, rel=0.15)
    coarse = encoder_error_deg(angle, NoiseModel(encoder_deg=10.0), stream(4, "encoder"))
    assert np.all(np.diff(angle + coarse) > 0)


def test_streams_differ_by_purpose_and_index_and_repeat():
    draws = {(p, k): stream(1, p, k).random() for p in PURPOSES for k in range(3)}
    assert len(set(draws.values())) == len(draws)
    assert stream(1, "stripe", 1, 2).random() == stream(1, "stripe", 1, 2).random()
    assert stream(1, "stripe", 1, 2).random() != stream(2, "stripe", 1, 2).random()
    lengths = [np.linalg.norm(in_ball(stream(k, "rig"), 2.0)) for k in range(300)]
    assert max(lengths) < 2.0
    assert np.mean(lengths) == pytest.approx(1.5, abs=0.1)  # 3/4 of the radius


@pytest.mark.parametrize("sigma", [1.0, 2.5])
def test_images_hold_the_lines_where_they_should(sigma):
    rows = np.arange(300)
    first = 120.0 + 0.11 * rows
    first[100:120] = np.nan
    second = first + 90.0
    second[250] = 900.0  # beyond the image
    frames = list(render_frames([first[None], second[None]], (320, 300), sigma, stream(5, "image")))
    assert len(frames) == 1
    image = frames[0]
    assert image.shape == (300, 320)
    assert image.dtype == np.uint8
    light = np.maximum(image.astype(float) - 9.0 - 3 * 1.6, 0.0)
    for centre in (first, second):
        errors = []
        for row in rows[np.isfinite(centre) & (centre < 300)]:
            columns = np.arange(int(centre[row]) - 12, int(centre[row]) + 14)
            errors.append((light[row, columns] @ columns) / light[row, columns].sum() - centre[row])
        assert len(errors) > 270
        assert abs(np.mean(errors)) < 0.01
        assert 0.002 < np.std(errors) < 0.15
    assert image[105].max() < 30
    assert image[250, 260:].max() < 30
