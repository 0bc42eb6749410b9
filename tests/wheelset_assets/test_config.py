"""Configuration: strict, frozen, fingerprinted; and errors that say which file and which key."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from wheelset_assets.config import Config, load_config
from wheelset_assets.quality import ConfigError
from wheelset_assets.stages import CONFIG_SECTIONS, STAGES

KNOBS = [(section, knob) for section, part in Config.model_fields.items() for knob in part.annotation.model_fields]


def written(tmp_path, text):
    path = tmp_path / "my.toml"
    path.write_text(text, encoding="utf-8")
    return path


def other_value(section: str, knob: str):
    """An allowed value that is not the default."""
    field = Config.model_fields[section].annotation.model_fields[knob]
    default = field.default
    if isinstance(default, tuple):
        return (*default[:-1], default[-1] + 1.0)
    if isinstance(default, str):
        return next(v for v in field.annotation.__args__ if v != default)
    if isinstance(default, int):
        return default + 1
    tops = [getattr(limit, side) for limit in field.metadata for side in ("le", "lt") if hasattr(limit, side)]
    if not tops:
        return 1.5 * default
    return 0.5 * (default + tops[0]) if default < tops[0] else 0.9 * default


def test_no_file_is_the_defaults():
    assert load_config(None) == Config()


def test_a_file_overrides_what_it_names_and_nothing_else(tmp_path):
    path = written(
        tmp_path, "[filtering]\noutlier_sigmas = 6.5\nsmoothing = 'median'\n[measurement]\ndatum_mm = 77.79\n"
    )
    found = load_config(path)
    assert found.filtering.outlier_sigmas == 6.5
    assert found.filtering.smoothing == "median"
    assert found.measurement.datum_mm == 77.79
    changed = found.model_dump()
    for section, knob in (("filtering", "outlier_sigmas"), ("filtering", "smoothing"), ("measurement", "datum_mm")):
        changed[section][knob] = getattr(getattr(Config(), section), knob)
    assert changed == Config().model_dump()


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("[filtering]\noutlier_sigma = 6.5\n", "filtering.outlier_sigma"),
        ("[filtring]\nwindow_rows = 5\n", "filtring"),
        ("[filtering]\noutlier_sigmas = 1.0\n", "filtering.outlier_sigmas"),
        ("[filtering]\noutlier_sigmas = nan\n", "filtering.outlier_sigmas"),
        ("[filtering]\nsmoothing = 'mittel'\n", "filtering.smoothing"),
        ("[triangulation]\nmethod = 3\n", "triangulation.method"),
        ("[measurement]\nmin_frames = 'eight'\n", "measurement.min_frames"),
        ("[measurement]\nmin_frames = 8.5\n", "measurement.min_frames"),
        ("filtering = 3\n", "filtering"),
    ],
)
def test_errors_name_the_file_and_the_key(tmp_path, text, key):
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as error:
        load_config(path)
    assert str(path) in str(error.value)
    assert f"{key}:" in str(error.value)


def test_errors_show_what_was_found(tmp_path):
    with pytest.raises(ConfigError, match=r"got 1\.0"):
        load_config(written(tmp_path, "[filtering]\noutlier_sigmas = 1.0\n"))


def test_files_that_are_missing_or_no_toml_are_named(tmp_path):
    missing = tmp_path / "none.toml"
    with pytest.raises(ConfigError, match=r"none\.toml.*cannot be read"):
        load_config(missing)
    with pytest.raises(ConfigError, match=r"my\.toml.*not a TOML file"):
        load_config(written(tmp_path, "[filtering\n"))
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"binary\.toml.*not a TOML file"):
        load_config(binary)


def test_sections_cannot_be_changed():
    with pytest.raises(ValidationError):
        Config().filtering.outlier_sigmas = 7.0


@pytest.mark.parametrize(("section", "knob"), KNOBS, ids=[f"{s}.{k}" for s, k in KNOBS])
def test_every_knob_is_described_and_changes_its_sections_fingerprint_alone(section, knob):
    field = Config.model_fields[section].annotation.model_fields[knob]
    assert field.description
    assert not field.description.endswith(".")
    changed = Config.model_validate({section: {knob: other_value(section, knob)}})
    for name in Config.model_fields:
        same = getattr(changed, name).fingerprint() == getattr(Config(), name).fingerprint()
        assert same == (name != section)


@given(st.floats(2.001, 50))
def test_fingerprints_follow_values_and_not_how_they_were_written(sigmas):
    one = Config.model_validate({"filtering": {"outlier_sigmas": sigmas}})
    again = Config.model_validate({"filtering": {"window_rows": 7, "outlier_sigmas": sigmas}})
    assert one.filtering.fingerprint() == again.filtering.fingerprint()
    assert len(one.filtering.fingerprint()) == 16
    assert (one.filtering.fingerprint() == Config().filtering.fingerprint()) == (sigmas == 5.0)


def test_every_stage_has_its_section_and_every_section_its_stage():
    assert set(CONFIG_SECTIONS.values()) == set(Config.model_fields)
    for stage in STAGES:
        assert Config.model_fields[CONFIG_SECTIONS[stage.name]].annotation is stage.config_type
