"""The eight stages as declared: an order that feeds itself, versions, and one section of configuration each."""

from __future__ import annotations

from wheelset_assets import stages

RAW = {"boards", "rig", "stripes", "scan", "frames", "reference", "nominal"}


def test_every_input_was_made_by_an_earlier_stage():
    made: set[str] = set()
    for stage in stages.STAGES:
        assert set(stage.inputs) <= made, stage.name
        assert set(stage.raw_inputs) <= RAW
        for name in stage.optional_inputs:  # of the reference scan, which went through all stages before
            assert name.removeprefix("reference_") in {t.name for s in stages.STAGES for t in s.outputs}
        made |= {t.name for t in stage.outputs}


def test_there_are_eight_in_their_order():
    assert [s.name for s in stages.STAGES] == [
        "calibrations", "triangulated_clouds", "filtered_clouds", "features", "registrations", "alignments",
        "measurements", "repeatability",
    ]  # fmt: skip
    assert [s.scope for s in stages.STAGES] == ["calibration", *["scan"] * 6, "fleet"]
    assert stages.STAGES[1:7] == stages.SCAN_STAGES


def test_versions_are_theirs_and_their_tables():
    for stage in stages.STAGES:
        assert stage.version >= 1
        assert stage.code_version.split(".") == [str(v) for v in (stage.version, *(t.version for t in stage.outputs))]
        assert stage.meaning
        assert len(stage.run.__doc__) > 20
