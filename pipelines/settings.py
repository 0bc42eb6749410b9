"""Where inbox, warehouse and configuration are, from options or the environment, and Dagster's home in the warehouse."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from warehouse import place, store
from warehouse.bounds import DEFAULT, Bounds
from wheelset_assets.config import Config, load_config
from wheelset_assets.quality import ConfigError

DAGSTER_YAML = b"""# Written by wheelset. No telemetry, no sign-up window, one run at a time on this warehouse.
telemetry:
  enabled: false
nux:
  enabled: false
concurrency:
  runs:
    max_concurrent_runs: 1
# A run that the daemon launched and that died must not keep the place of the next.
run_monitoring:
  enabled: true
# No capture of what steps print: it costs two processes a step, and the steps print nothing but progress.
compute_logs:
  module: dagster._core.storage.noop_compute_log_manager
  class: NoOpComputeLogManager
"""


@dataclass(frozen=True)
class Settings:
    """Places and knobs of a run."""

    inbox: Path
    warehouse: Path
    config_path: Path | None
    config: Config
    workers: int
    cluster: str | None = None
    bounds: Bounds = DEFAULT
    notify: str | None = None


def settings(
    inbox: Path | None = None,
    warehouse: Path | None = None,
    config: Path | None = None,
    workers: int | None = None,
    cluster: str | None = None,
    limits: dict[str, float | None] | None = None,
    notify: str | None = None,
) -> Settings:
    """Settings from arguments, else from the environment (WHEELSET_ and the name in capitals), else defaults."""
    config = config or _path("WHEELSET_CONFIG")
    inbox = place.check(inbox or _path("WHEELSET_INBOX") or Path("inbox"))
    warehouse = place.check(warehouse or _path("WHEELSET_WAREHOUSE") or Path("warehouse-data"))
    cluster = cluster or os.environ.get("WHEELSET_CLUSTER") or None
    notify = notify or os.environ.get("WHEELSET_NOTIFY") or None
    if cluster is not None:  # its workers stand in folders of their own
        inbox, warehouse = inbox.resolve(), warehouse.resolve()
    if workers is None:
        text = os.environ.get("WHEELSET_WORKERS") or str(max(1, min(os.cpu_count() or 1, 8)))
        if not (text.isascii() and text.isdigit()):
            raise ConfigError(f"WHEELSET_WORKERS: expected a whole number; found {text!r}")
        workers = int(text)
    return Settings(inbox, warehouse, config, load_config(config), workers, cluster, _bounds(limits or {}), notify)


def _bounds(given: dict[str, float | None]) -> Bounds:
    """Limits of a run: those given, else WHEELSET_TASK_SECONDS, WHEELSET_MEMORY_GB, WHEELSET_DISK_FLOOR_GB, else defaults."""
    found = {}
    for name in ("task_seconds", "memory_gb", "disk_floor_gb"):
        variable = f"WHEELSET_{name.upper()}"
        value: float | str | None = given.get(name)
        if value is None:
            value = os.environ.get(variable) or None
        if value is not None:
            try:
                found[name] = float(value)
            except ValueError as error:
                raise ConfigError(f"{variable}: expected a number; found {value!r}") from error
    return Bounds(**found)


def configuration() -> Config:
    """The configuration that the environment names, and no look at inbox or warehouse: for what is only declared."""
    return load_config(_path("WHEELSET_CONFIG"))


def _path(name: str) -> Path | None:
    return place.place(os.environ[name]) if os.environ.get(name) else None


def dagster_home(warehouse: Path) -> Path:
    """Dagster's home inside the warehouse, made if need be, so that its UI later shows the runs of the command line.

    Of a warehouse in object storage it lies on this machine: DAGSTER_HOME if that is set (its dagster.yaml may name a
    database that several machines share), else below XDG_STATE_HOME.
    """
    home = warehouse.resolve() / "_dagster"
    if place.is_remote(warehouse):
        state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
        home = Path(os.environ.get("DAGSTER_HOME") or state / "wheelset" / place.cache_folder(warehouse).name)
    if not (home / "dagster.yaml").exists():
        store.write_bytes(home / "dagster.yaml", DAGSTER_YAML)
    os.environ["DAGSTER_HOME"] = str(home)
    os.environ.setdefault("DAGSTER_DISABLE_TELEMETRY", "1")
    return home
