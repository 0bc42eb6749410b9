"""Recordings: what the warehouse knows of one scan, rebuilt from stored tables as a file that rerun's viewer opens.

No algorithm is instrumented and none is run again; a recording can be thrown away and written anew. rerun is imported
when a recording is written, never with this module.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

from warehouse import place
from wheelset_assets.quality import ConfigError

if TYPE_CHECKING:
    from pipelines.recording.canvas import Canvas
    from pipelines.recording.source import Source

APPLICATION = "wheelset"
SUFFIX = ".rrd"
MAX_POINTS = 60_000
START_SECONDS = 2.0
"""A viewer that lives this long has started."""


def write_recording(
    root: Path,
    scan_id: str,
    out: Path,
    inbox: Path | None = None,
    max_points: int = MAX_POINTS,
    *,
    active_tab: str | None = None,
) -> Path:
    """Write the recording of a scan, measured or not, to `out` (a file, or a folder for `<scan_id>.rrd`); returns its path.

    Raw stripes are shown if `inbox` still has the bundle's files with the hashes on record. Each cloud is thinned evenly
    to `max_points`. It opens on `active_tab`, if it has that. ConfigError names the nearest scans if there is none.
    """
    from pipelines.recording.source import open_source

    if max_points < 1:
        raise ConfigError(f"a recording needs at least one point a cloud, got max_points {max_points}")
    target = out / f"{scan_id}{SUFFIX}" if out.is_dir() else out
    with closing(open_source(root, scan_id, inbox)) as source, ExitStack() as stack:
        try:
            place.make_folder(target.parent)
            temporary = stack.enter_context(place.landing(target))
            temporary.touch()
        except OSError as error:
            raise ConfigError(f"{target}: cannot be written: {error.strerror}") from error
        _save(source, temporary, max_points, active_tab)
    return target


def _save(source: Source, file: Path, max_points: int, active_tab: str | None) -> None:
    import rerun as rr

    from pipelines.recording.blueprint import blueprint
    from pipelines.recording.canvas import Canvas

    rec = rr.RecordingStream(APPLICATION, recording_id=f"{source.scan_id}.{source.deciding.run_id or 'no-run'}")
    try:
        rec.save(file)
        canvas = Canvas(rec, source, max_points)
        _draw(canvas)
        rec.send_blueprint(blueprint(canvas, active_tab))
    finally:
        rec.disconnect()  # flushes, and writes the footer


def _draw(canvas: Canvas) -> None:
    """All subjects, each from what is stored; the report last, when every gap is known."""
    import rerun as rr

    from pipelines.recording import calibration, clouds, keypoints, meridian, report, rig, stripes, turns

    source = canvas.source
    for subject in (rig, calibration, clouds, stripes, keypoints, meridian, turns):
        subject.draw(canvas)
    canvas.document("report", report.report(source))
    canvas.document("summary", report.summary(source))
    canvas.rec.send_recording_name(f"{source.scan_id} ({source.state})")
    facts = rr.AnyValues(
        scan_id=source.scan_id,
        state=source.state,
        stage=source.stage,
        reason=source.reason or "",
        run_id=source.deciding.run_id,
    )
    canvas.rec.send_property("scan", facts)


def viewer_command(path: Path) -> list[str]:
    """Command line of the viewer over a recording, reachable from this machine only."""
    return [sys.executable, "-m", "rerun_cli", str(path), "--bind", "127.0.0.1", "--port", "auto"]


def viewer_environment() -> dict[str, str]:
    """Environment in which the viewer sends no usage data: it sends none under CI, and has no switch but its settings file."""
    kept = {name: value for name, value in os.environ.items() if name != "FORCE_RERUN_ANALYTICS"}
    return kept | {"CI": "true"}


def open_recording(path: Path) -> subprocess.Popen[bytes]:
    """Start the viewer over a recording; it lives on when this program ends. ConfigError if it ends at once."""
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such recording; `wheelset replay SCAN --out {path}` writes one")
    if place.is_remote(path):
        local = place.cache_folder(path) / path.name
        place.fetch(path, local)
        path = local
    quiet = subprocess.DEVNULL
    with tempfile.TemporaryFile() as said:
        viewer = subprocess.Popen(
            viewer_command(path),
            env=viewer_environment(),
            stdin=quiet,
            stdout=quiet,
            stderr=said,
            start_new_session=True,
        )
        try:
            viewer.wait(START_SECONDS)
        except subprocess.TimeoutExpired:
            return viewer
        said.seek(0)
        lines = said.read().decode(errors="replace").strip().splitlines() or [f"exit code {viewer.returncode}"]
    browser = f"{sys.executable} -m rerun_cli {path} --bind 127.0.0.1 --web-viewer"
    raise ConfigError(f"the viewer did not start ({lines[-1].strip()}); to look at it in a browser: {browser}")
