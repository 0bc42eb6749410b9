"""The lock files: from no particular host, every file with its hash, and in step with pyproject.toml."""

import functools
import re
import tomllib
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
LOCKS = ("requirements.lock", "requirements-dev.lock")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
BUILD = PROJECT["build-system"]["requires"]  # pip builds the project with what the lock installed
RUNTIME = [*BUILD, *PROJECT["project"]["dependencies"]]
DEV = [*RUNTIME, *PROJECT["project"]["optional-dependencies"]["dev"]]

SYSTEMS = {
    "linux": {"sys_platform": "linux", "platform_machine": "x86_64", "platform_system": "Linux", "os_name": "posix"},
    "linux-arm": {"sys_platform": "linux", "platform_machine": "aarch64", "platform_system": "Linux"},
    "macos": {"sys_platform": "darwin", "platform_machine": "arm64", "platform_system": "Darwin", "os_name": "posix"},
    "windows": {"sys_platform": "win32", "platform_machine": "AMD64", "platform_system": "Windows", "os_name": "nt"},
}
TARGETS = [(python, system) for python in ("3.11", "3.12", "3.13") for system in SYSTEMS]


def environment(python: str, system: str) -> dict[str, str]:
    full = {"python_version": python, "python_full_version": f"{python}.1", "implementation_version": f"{python}.1"}
    return {**default_environment(), **full, **SYSTEMS[system]}


@functools.cache
def entries(lock: str) -> list[tuple[Requirement, list[str]]]:
    """The requirements of a lock file, each with its hashes."""
    text = re.sub(r"^\s*#.*\n", "", (ROOT / lock).read_text(encoding="utf-8"), flags=re.MULTILINE)
    found = []
    for line in text.replace("\\\n", " ").splitlines():
        requirement, *hashes = re.split(r"\s+--hash=", line.strip())
        found.append((Requirement(requirement), hashes))
    return found


@functools.cache
def versions(lock: str, python: str, system: str) -> dict[str, list[str]]:
    """What pip installs from a lock file on that Python and system: for each name the versions asked for."""
    chosen: dict[str, list[str]] = {}
    for requirement, _ in entries(lock):
        if requirement.marker is None or requirement.marker.evaluate(environment(python, system)):
            (pin,) = requirement.specifier
            chosen.setdefault(canonicalize_name(requirement.name), []).append(pin.version)
    return chosen


@pytest.mark.parametrize("lock", LOCKS)
def test_names_no_host(lock: str) -> None:
    text = (ROOT / lock).read_text(encoding="utf-8")
    assert "://" not in text
    assert " @ " not in text
    assert re.findall(r"^\s*-(?!-hash=).*", text, re.MULTILINE) == []
    assert re.findall(r"(?i)\b[\w-]+\.(?:com|org|net|io|dev|example|internal|local)\b|localhost", text) == []


@pytest.mark.parametrize("lock", LOCKS)
def test_every_requirement_is_one_version_with_hashes(lock: str) -> None:
    for requirement, hashes in entries(lock):
        assert [pin.operator for pin in requirement.specifier] == ["=="], requirement
        assert requirement.url is None
        assert hashes, requirement
        assert all(re.fullmatch("sha256:[0-9a-f]{64}", digest) for digest in hashes), requirement


@pytest.mark.parametrize(("lock", "wanted"), zip(LOCKS, (RUNTIME, DEV), strict=True), ids=LOCKS)
@pytest.mark.parametrize(("python", "system"), TARGETS)
def test_holds_every_direct_dependency(lock: str, wanted: list[str], python: str, system: str) -> None:
    locked = versions(lock, python, system)
    assert {name: pins for name, pins in locked.items() if len(pins) != 1} == {}
    for requirement in map(Requirement, wanted):
        if requirement.marker is None or requirement.marker.evaluate(environment(python, system)):
            (version,) = locked.get(canonicalize_name(requirement.name), ["absent"])
            assert version != "absent", f"{requirement} is not in {lock}: run .ci/lock"
            assert requirement.specifier.contains(version, prereleases=True), f"{requirement}: {lock} has {version}"


@pytest.mark.parametrize(("python", "system"), TARGETS)
def test_development_adds_to_runtime_and_changes_nothing(python: str, system: str) -> None:
    runtime, dev = (versions(lock, python, system) for lock in LOCKS)
    assert {name: dev.get(name) for name in runtime} == runtime
