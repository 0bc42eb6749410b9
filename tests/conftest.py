"""What every test can count on: no telemetry, no window, no settings of the user's, and where the shared data is."""

import json
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

_home = Path(tempfile.mkdtemp(prefix="wheelset-tests-"))  # where libraries keep what they keep under the user's home


def _isolate(home: Path) -> None:
    """Before any library is imported: nothing is sent anywhere, and nothing is read from or left in the user's home."""
    os.environ.pop("DAGSTER_HOME", None)
    os.environ["DAGSTER_DISABLE_TELEMETRY"] = "yes"
    os.environ["MPLBACKEND"] = "Agg"
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"  # as the command line does before numpy is loaded: sums must not depend on the cores
    for name in ("XDG_CONFIG_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "MPLCONFIGDIR"):
        folder = home / name.lower()
        folder.mkdir()
        os.environ[name] = str(folder)
    # Rerun's command line has no variable for this, only its settings file, of which it wants every field.
    os.environ.pop("FORCE_RERUN_ANALYTICS", None)
    settings = home / "xdg_config_home" / "rerun" / "analytics.json"
    settings.parent.mkdir()
    content = {
        "analytics_enabled": False,
        "analytics_id": "",
        "metadata": {},
        "config_file_path": str(settings),
        "data_dir_path": str(home / "xdg_data_home" / "rerun"),
    }
    settings.write_text(json.dumps(content), encoding="utf-8")


_isolate(_home)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown() -> Iterator[None]:
    """What a command set for its own process (`settings.dagster_home`) must not reach the next test."""
    try:
        return (yield)
    finally:
        os.environ.pop("DAGSTER_HOME", None)


def pytest_unconfigure() -> None:
    shutil.rmtree(_home, ignore_errors=True)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings, beside the checkout: ../shared/data, or WHEELSET_SHARED_DATA.

    Where it is absent the test skips; in CI it fails, so that a whole class of tests cannot go missing unseen, unless
    WHEELSET_CI_WITHOUT_SHARED says that this CI has no such folder.
    """
    folder = Path(os.environ.get("WHEELSET_SHARED_DATA") or ROOT.parent / "shared" / "data").resolve()
    if folder.is_dir():
        return folder
    reason = f"no shared data: {folder} is not a folder (WHEELSET_SHARED_DATA names another)"
    if os.environ.get("CI", "").lower() in ("true", "1") and not os.environ.get("WHEELSET_CI_WITHOUT_SHARED"):
        pytest.fail(f"{reason}; where CI cannot have it, set WHEELSET_CI_WITHOUT_SHARED=1")
    pytest.skip(reason)


@pytest.fixture(scope="session")
def s3(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """A running S3-compatible server with a bucket, and the environment that leads to it."""
    pytest.importorskip("moto", reason="no S3-compatible server is installed")
    from s3_server import s3_server

    with s3_server(tmp_path_factory.mktemp("s3")) as environment:
        yield environment


@pytest.fixture
def prefix(s3: dict[str, str]) -> str:
    """An s3:// prefix of the test's own."""
    from s3_server import BUCKET

    return f"s3://{BUCKET}/{uuid.uuid4().hex}"
