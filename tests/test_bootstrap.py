"""bootstrap.py and .ci/checks.py: what they decide, with every command that they would run replaced by a stub."""

import ast
import ctypes
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent


def load(path: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def boot(tmp_path: Path) -> ModuleType:
    """bootstrap.py with a checkout of its own to work in."""
    module = load("bootstrap.py")
    module.ROOT = tmp_path
    module.VENV = tmp_path / ".venv"
    module.BIN = module.VENV / "bin"
    module.PYTHON = str(module.BIN / "python")
    module.STAMP = module.VENV / "bootstrap.json"
    module.LOCKS = {"runtime": tmp_path / "requirements.lock", "dev": tmp_path / "requirements-dev.lock"}
    for path in (*module.LOCKS.values(), tmp_path / "pyproject.toml"):
        path.write_text("numpy==2.0\n")
    return module


class Commands:
    """Stands in for bootstrap.attempt: remembers the commands, and fails those that a pattern matches."""

    def __init__(self, failing: str = "$^", effect: Callable[[str], None] = lambda line: None) -> None:
        self.failing, self.effect, self.lines = failing, effect, []

    def __call__(self, command: list[str]) -> tuple[bool, str]:
        line = " ".join(command)
        self.lines.append(line)
        self.effect(line)
        return re.search(self.failing, line) is None, f"output of {line}\n"


def lose(monkeypatch: pytest.MonkeyPatch, lost: set[str]) -> None:
    """Make the loader find no library of that set (which may change later), and every other one."""

    def cdll(name: str) -> None:
        if name in lost:
            raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(ctypes, "CDLL", cdll)
    monkeypatch.setattr(sys, "platform", "linux")


def managers(monkeypatch: pytest.MonkeyPatch, *present: str) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}" if name in present else None)


# The Python to use


def test_old_pythons_can_read_the_file() -> None:
    ast.parse((ROOT / "bootstrap.py").read_text(encoding="utf-8"), feature_version=(3, 7))


def test_is_short() -> None:
    assert len((ROOT / "bootstrap.py").read_text(encoding="utf-8").splitlines()) < 300


@pytest.mark.parametrize("running", [(3, 11), (3, 12), (3, 13)])
def test_a_supported_python_goes_on(boot: ModuleType, running: tuple[int, int]) -> None:
    assert boot.other_python(running) is None


def test_an_old_python_gives_way_to_the_newest_that_runs(boot: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    managers(monkeypatch, "python3.13", "python3.12", "python3.11")
    runs = {"python3.12": "3.12", "python3.11": "3.11"}  # python3.13 is there and does not run, as a shim may
    monkeypatch.setattr(boot, "version_of", lambda command: runs.get(command[0]))
    assert boot.other_python((3, 9)) == ["python3.12"]


def test_an_old_python_alone_is_told_the_remedy(boot: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    managers(monkeypatch)
    with pytest.raises(boot.Stop, match=r"this is Python 3\.9; install Python 3\.11, 3\.12 or 3\.13") as stop:
        boot.other_python((3, 9))
    assert stop.value.status == 2


def test_a_newer_python_alone_is_tried(
    boot: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    managers(monkeypatch)
    assert boot.other_python((3, 15)) is None
    assert "newer" in capsys.readouterr().out


def test_version_of(boot: ModuleType) -> None:
    assert boot.version_of([sys.executable]) == f"{sys.version_info[0]}.{sys.version_info[1]}"
    assert boot.version_of([str(boot.ROOT / "absent")]) is None


def test_children_are_led_to_the_environment(boot: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONHOME", "/nowhere")
    monkeypatch.setenv("PYTHONPATH", "/nowhere")
    monkeypatch.setenv("VIRTUAL_ENV", "/another")
    monkeypatch.setenv("PIP_CERT", "/etc/certificates.pem")
    child = boot.child_environment()
    assert not {"PYTHONHOME", "PYTHONPATH"} & set(child)
    assert child["VIRTUAL_ENV"] == str(boot.VENV)
    assert child["PATH"].split(os.pathsep)[0] == str(boot.BIN)
    assert child["PIP_CERT"] == "/etc/certificates.pem"


# What the machine must supply


def test_missing_libraries_are_found(boot: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    lose(monkeypatch, {"libusb-1.0.so.0", "libGL.so.1"})
    assert boot.missing_libraries() == ["libGL.so.1", "libusb-1.0.so.0"]
    missing, packages = boot.missing_parts(making_venv=False)
    assert missing == ["libGL.so.1", "libusb-1.0.so.0"]
    assert packages["apt-get"] == ["libgl1", "libusb-1.0-0"]
    assert packages["dnf"] == ["libglvnd-glx", "libusb1"]
    assert packages["zypper"] == ["libglvnd", "libusb-1_0-0"]
    assert packages["pacman"] == ["libglvnd", "libusb"]


def test_other_systems_are_not_asked_for_libraries(boot: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    lose(monkeypatch, set(boot.LIBRARIES))
    monkeypatch.setattr(sys, "platform", "darwin")
    assert boot.missing_libraries() == []


def test_a_missing_venv_module_is_found(boot: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    lose(monkeypatch, set())
    monkeypatch.setattr(boot, "attempt", Commands(failing="ensurepip"))
    assert boot.missing_parts(making_venv=False) == ([], {})
    missing, packages = boot.missing_parts(making_venv=True)
    assert missing == ["Python's venv module"]
    assert packages == {"apt-get": [f"python3.{sys.version_info[1]}-venv"]}


@pytest.mark.parametrize(
    ("present", "line"),
    [
        ("apt-get", "sudo apt-get install -y --no-install-recommends libgl1"),
        ("dnf", "sudo dnf install -y libglvnd-glx"),
        ("zypper", "sudo zypper --non-interactive install libglvnd"),
        ("pacman", "sudo pacman -S --needed --noconfirm libglvnd"),
    ],
)
def test_the_remedy_is_one_line(boot: ModuleType, monkeypatch: pytest.MonkeyPatch, present: str, line: str) -> None:
    lose(monkeypatch, {"libGL.so.1"})
    managers(monkeypatch, present)
    assert boot.remedies(boot.missing_parts(making_venv=False)[1]) == [line]


def test_the_remedy_for_an_unknown_system_is_a_line_for_each(boot: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    lose(monkeypatch, {"libGL.so.1"})
    managers(monkeypatch)
    assert len(boot.remedies(boot.missing_parts(making_venv=False)[1])) == 4


@pytest.mark.parametrize(("user", "prefix"), [(0, ""), (1000, "sudo -n ")])
def test_apt_installs_where_it_may(boot: ModuleType, monkeypatch: pytest.MonkeyPatch, user: int, prefix: str) -> None:
    lost = {"libGL.so.1"}
    lose(monkeypatch, lost)
    managers(monkeypatch, "apt-get")
    monkeypatch.setattr(os, "geteuid", lambda: user, raising=False)
    commands = Commands(effect=lambda line: lost.clear() if " install " in line else None)
    monkeypatch.setattr(boot, "attempt", commands)
    boot.ensure_machine(making_venv=False)
    apt = f"{prefix}env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120"
    assert commands.lines == [
        f"{prefix}true",
        f"{apt} update",
        f"{apt} install -y --no-install-recommends libgl1",
    ]


def test_without_leave_to_install_it_stops_and_says_how(boot: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    lose(monkeypatch, {"libGL.so.1"})
    managers(monkeypatch, "apt-get")
    monkeypatch.setattr(os, "geteuid", lambda: 1000, raising=False)
    commands = Commands(failing="^sudo|ensurepip")
    monkeypatch.setattr(boot, "attempt", commands)
    with pytest.raises(boot.Stop, match=r"sudo apt-get install -y --no-install-recommends libgl1 python3\.") as stop:
        boot.ensure_machine(making_venv=True)
    assert stop.value.status == 2
    assert not [line for line in commands.lines if "apt-get" in line]


def test_a_failed_install_is_shown_and_stops(
    boot: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lose(monkeypatch, {"libGL.so.1"})
    managers(monkeypatch, "apt-get")
    monkeypatch.setattr(os, "geteuid", lambda: 0, raising=False)
    monkeypatch.setattr(boot, "attempt", Commands(failing=" install "))
    with pytest.raises(boot.Stop, match=r"libGL\.so\.1"):
        boot.ensure_machine(making_venv=False)
    assert "output of env" in capsys.readouterr().out


@pytest.mark.parametrize(("version", "good"), [("2.31", False), ("2.34", False), ("2.35", True), ("2.100", True)])
def test_too_old_a_c_library_stops(boot: ModuleType, monkeypatch: pytest.MonkeyPatch, version: str, good: bool) -> None:
    lose(monkeypatch, set())
    monkeypatch.setattr(boot.platform, "libc_ver", lambda: ("glibc", version))
    if good:
        boot.ensure_machine(making_venv=False)
    else:
        with pytest.raises(boot.Stop, match=r"glibc 2\.35"):
            boot.ensure_machine(making_venv=False)


@pytest.mark.skipif(not sys.platform.startswith("linux") or not shutil.which("ldd"), reason="needs Linux and ldd")
def test_the_table_is_what_open3d_links_to() -> None:
    """Every library that the loader takes for libOpen3D.so from the system is there, and is what the table lists."""
    spec = importlib.util.find_spec("open3d")  # found, not imported
    assert spec is not None
    assert spec.origin is not None
    (library,) = Path(spec.origin).parent.glob("libOpen3D.so*")
    output = subprocess.run(["ldd", str(library)], capture_output=True, text=True, check=True).stdout
    assert "not found" not in output
    assert {name for name in load("bootstrap.py").LIBRARIES if name not in output} <= {"libz.so.1"}  # NumPy's


# The environment


NOW = {"place": "/here/.venv", "python": "3.11", "runtime": "r1", "dev": "d1", "project": "p1"}
ALL = ["venv", "packages", "project"]


@pytest.mark.parametrize(
    ("stamp", "dev", "steps"),
    [
        ({}, False, ALL),  # no environment, or one that was cut short
        (NOW, False, []),
        (NOW, True, []),
        (NOW | {"dev": None}, False, []),
        (NOW | {"dev": None}, True, ["packages"]),
        (NOW | {"project": "p0"}, False, ["project"]),
        (NOW | {"project": "p0", "dev": None}, True, ["packages", "project"]),
        (NOW | {"runtime": "r0"}, False, ALL),
        (NOW | {"dev": "d0"}, False, ALL),
        (NOW | {"python": "3.10"}, False, ALL),
        (NOW | {"place": "/elsewhere/.venv"}, False, ALL),
    ],
)
def test_plan(boot: ModuleType, stamp: dict[str, str | None], dev: bool, steps: list[str]) -> None:
    assert boot.plan(stamp, NOW, dev) == steps


def test_an_environment_whose_python_is_gone_is_made_anew(boot: ModuleType) -> None:
    now = NOW | {"python": None}
    assert boot.plan(now, now, False) == ALL


@pytest.fixture
def installs(boot: ModuleType, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The steps that ensure_environment takes, none of them in earnest."""
    taken: list[str] = []

    def make_venv() -> None:
        taken.append("venv")
        boot.VENV.mkdir(exist_ok=True)

    monkeypatch.setattr(boot, "ensure_machine", lambda making_venv: None)
    monkeypatch.setattr(boot, "version_of", lambda command: "3.11" if boot.VENV.exists() else None)
    monkeypatch.setattr(boot, "make_venv", make_venv)
    monkeypatch.setattr(boot, "pip_install", lambda *arguments: taken.append(Path(arguments[-1]).name))
    return taken


def test_an_environment_is_made_once(boot: ModuleType, installs: list[str]) -> None:
    boot.ensure_environment(dev=False)
    assert installs == ["venv", "requirements.lock", boot.ROOT.name]
    boot.ensure_environment(dev=False)
    assert len(installs) == 3


def test_development_tools_are_added_once(boot: ModuleType, installs: list[str]) -> None:
    boot.ensure_environment(dev=False)
    del installs[:]
    boot.ensure_environment(dev=True)
    assert installs == ["requirements-dev.lock", boot.ROOT.name]
    for dev in (True, False):
        boot.ensure_environment(dev)
    assert len(installs) == 2


def test_a_changed_project_is_installed_again_and_the_tools_stay(boot: ModuleType, installs: list[str]) -> None:
    boot.ensure_environment(dev=True)
    del installs[:]
    (boot.ROOT / "pyproject.toml").write_text("changed")
    boot.ensure_environment(dev=False)
    boot.ensure_environment(dev=True)
    assert installs == [boot.ROOT.name]


def test_a_run_cut_short_is_made_good(boot: ModuleType, installs: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    boot.ensure_environment(dev=False)
    boot.LOCKS["runtime"].write_text("numpy==2.1\n")

    def interrupted(*arguments: str) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(boot, "pip_install", interrupted)
        with pytest.raises(KeyboardInterrupt):
            boot.ensure_environment(dev=False)
    assert boot.read_stamp() == {}
    del installs[:]
    boot.ensure_environment(dev=False)
    assert installs == ["venv", "requirements.lock", boot.ROOT.name]


@pytest.mark.parametrize("content", ["", "[]", "{"])
def test_a_spoilt_stamp_counts_as_none(boot: ModuleType, content: str) -> None:
    boot.VENV.mkdir()
    boot.STAMP.write_text(content)
    assert boot.read_stamp() == {}


def fake_pip(boot: ModuleType, monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    """Let this Python play pip: it runs that program."""
    popen = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda command, **kw: popen([sys.executable, "-c", program], **kw))


def test_pip_is_quiet_but_for_large_packages(
    boot: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [
        "Collecting open3d-cpu==0.20.0",
        "  Downloading open3d_cpu-0.20.0-cp311-cp311-manylinux_2_35_x86_64.whl (105.0 MB)",
        "  Downloading six-1.17.0-py2.py3-none-any.whl (11 kB)",
        "Installing collected packages: six, open3d-cpu",
    ]
    fake_pip(boot, monkeypatch, f"print({chr(10).join(lines)!r})")
    boot.pip_install("-r", "x")
    said = [line.split(maxsplit=3)[-1] for line in capsys.readouterr().out.splitlines()]
    assert said == ["fetching open3d_cpu, 105.0 MB", "unpacking"]


def test_pip_failing_shows_its_output(
    boot: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fake_pip(boot, monkeypatch, "print('THESE PACKAGES DO NOT MATCH THE HASHES'); raise SystemExit(1)")
    with pytest.raises(boot.Stop, match="pip failed") as stop:
        boot.pip_install("-r", "x")
    assert stop.value.status == 1
    assert "DO NOT MATCH THE HASHES" in capsys.readouterr().out


# The commands


@pytest.fixture
def calls(boot: ModuleType, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """What main asks for: ("environment", "dev" or "runtime"), then the command that it ends in."""
    made: list[tuple[str, ...]] = []

    def call(command: list[str], **keywords: object) -> int:
        made.append(tuple(command))
        return 7

    kinds = {True: "dev", False: "runtime"}
    monkeypatch.setattr(boot, "ensure_environment", lambda dev: made.append(("environment", kinds[dev])))
    monkeypatch.setattr(boot, "other_python", lambda running: None)
    monkeypatch.setattr(subprocess, "call", call)
    return made


@pytest.mark.parametrize(
    ("arguments", "kind", "command"),
    [
        ("demo", "runtime", "{bin}/wheelset demo"),
        ("demo --out x --help", "runtime", "{bin}/wheelset demo --out x --help"),
        ("wheelset ls -v", "runtime", "{bin}/wheelset ls -v"),
        ("test", "dev", "{bin}/python {root}/.ci/checks.py"),
        ("test --only pytest -- -k rigid", "dev", "{bin}/python {root}/.ci/checks.py --only pytest -- -k rigid"),
    ],
)
@pytest.mark.skipif(os.name == "nt", reason="compares POSIX paths")
def test_commands(boot: ModuleType, calls: list[tuple[str, ...]], arguments: str, kind: str, command: str) -> None:
    assert boot.main(arguments.split()) == 7
    assert calls == [("environment", kind), tuple(command.format(bin=boot.BIN, root=boot.ROOT).split())]


@pytest.mark.parametrize(("arguments", "kind"), [(["install"], "runtime"), (["install", "--dev"], "dev")])
def test_install(boot: ModuleType, calls: list[tuple[str, ...]], arguments: list[str], kind: str) -> None:
    assert boot.main(arguments) == 0
    assert calls == [("environment", kind)]


@pytest.mark.parametrize("arguments", [["dmeo"], ["install", "--develop"]])
def test_what_is_not_understood_does_nothing(
    boot: ModuleType, calls: list[tuple[str, ...]], arguments: list[str]
) -> None:
    with pytest.raises(boot.Stop):
        boot.main(arguments)
    assert calls == []


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_help_teaches(boot: ModuleType, capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    assert boot.main(arguments) == 0
    out = capsys.readouterr().out
    assert all(f"bootstrap.py {command}" in out for command in ("demo", "test", "install", "wheelset", "doctor"))


def test_an_unsupported_python_starts_the_other(
    boot: ModuleType, calls: list[tuple[str, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(boot, "other_python", lambda running: ["python3.12"])
    assert boot.main(["demo", "x"]) == 7
    assert calls == [("python3.12", str(boot.ROOT / "bootstrap.py"), "demo", "x")]


def test_doctor_changes_nothing_and_names_what_is_missing(
    boot: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lose(monkeypatch, {"libGL.so.1"})
    managers(monkeypatch, "dnf")
    assert boot.main(["doctor"]) == 2
    out = capsys.readouterr().out
    assert "missing libGL.so.1" in out
    assert "sudo dnf install -y libglvnd-glx" in out
    assert not boot.VENV.exists()


# The checks


@pytest.fixture
def checks() -> ModuleType:
    return load(".ci/checks.py")


def test_parts_and_pytest_arguments(checks: ModuleType) -> None:
    assert checks.parse([]) == (["lint", "types", "contracts", "pytest"], [])
    assert checks.parse(["--only", "lint", "--only", "types"]) == (["lint", "types"], [])
    assert checks.parse(["--only", "pytest", "--", "-k", "rigid", "--", "x"]) == (
        ["pytest"],
        ["-k", "rigid", "--", "x"],
    )
    with pytest.raises(SystemExit):
        checks.parse(["--only", "nonsense"])


@pytest.mark.parametrize(
    ("failing", "status"), [(None, 0), ("ruff", 1), ("mypy", 1), ("lint-imports", 1), ("python", 1)]
)
def test_all_checks_run_whatever_fails_and_pytest_is_last(
    checks: ModuleType, monkeypatch: pytest.MonkeyPatch, failing: str | None, status: int
) -> None:
    ran: list[str] = []

    def call(command: list[str], **keywords: object) -> int:
        ran.append(Path(command[0]).name)
        return int(ran[-1] == failing)

    monkeypatch.setattr(subprocess, "call", call)
    assert checks.main([]) == status
    assert ran == ["ruff", "ruff", "mypy", "lint-imports", "python"]


# The shared data


@pytest.mark.parametrize(
    ("settings", "outcome"),
    [
        ({}, "1 skipped"),
        ({"CI": "true"}, "1 error"),
        ({"CI": "true", "WHEELSET_CI_WITHOUT_SHARED": "1"}, "1 skipped"),
        ({"CI": "true", "WHEELSET_SHARED_DATA": "."}, "1 passed"),
    ],
)
def test_shared_data_is_not_skipped_unseen(tmp_path: Path, settings: dict[str, str], outcome: str) -> None:
    shutil.copy(ROOT / "tests" / "conftest.py", tmp_path)
    (tmp_path / "test_it.py").write_text("def test_it(shared_data): assert shared_data.is_dir()\n")
    ours = ("CI", "WHEELSET_CI_WITHOUT_SHARED", "WHEELSET_SHARED_DATA")
    env = {name: value for name, value in os.environ.items() if name not in ours and not name.startswith("PYTEST")}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--rootdir",
        str(tmp_path),
        str(tmp_path),
    ]
    absent = {"WHEELSET_SHARED_DATA": str(tmp_path / "absent"), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(command, cwd=tmp_path, env=env | absent | settings, capture_output=True, text=True)
    assert outcome in done.stdout.splitlines()[-1], done.stdout


def test_nothing_is_sent_or_shown() -> None:
    assert os.environ["DAGSTER_DISABLE_TELEMETRY"]
    assert "DAGSTER_HOME" not in os.environ
    assert os.environ["MPLBACKEND"] == "Agg"
    settings = Path(os.environ["XDG_CONFIG_HOME"]) / "rerun" / "analytics.json"
    assert json.loads(settings.read_text(encoding="utf-8"))["analytics_enabled"] is False
