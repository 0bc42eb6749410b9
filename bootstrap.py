#!/usr/bin/env python3
"""Make this checkout's own environment, then use it.  Needs Python 3.11, 3.12 or 3.13 and nothing else.

  python3 bootstrap.py demo [ARGS]       install, then run `wheelset demo ARGS`
  python3 bootstrap.py test [OPTIONS]    install with development tools, then every check, then the tests
        --only lint|types|contracts|pytest   that part alone (may be repeated)
        -- ARGS                              what follows goes to pytest:  test --only pytest -- -k rigid
  python3 bootstrap.py install [--dev]   install, and no more
  python3 bootstrap.py wheelset ARGS     install, then run `wheelset ARGS`
  python3 bootstrap.py doctor            say what is in place and what is missing; change nothing

The environment is the folder .venv beside this file.  Its packages are those of requirements.lock (for test, of
requirements-dev.lock: the same and the development tools), each checked against its hash; the project itself is
installed editable, so that a changed source needs no new install.  The first run takes some minutes, later ones find
nothing to do, and a run that was cut short is made good by the next.  To use another Python, delete .venv and run
this file with the one wanted.

On Linux, Open3D needs a few shared libraries of the system.  Missing ones are installed where nobody need be asked
(apt-get, as root or with a sudo that wants no password); elsewhere the line that installs them is printed.

Exit status: 0 all well; 1 a check, a test or the install failed; 2 something is missing that you must supply.
"""

# Old Pythons (from 3.7) can read this file too, and so get a remedy rather than a syntax error.
from __future__ import annotations

import ctypes
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
BIN = VENV / ("Scripts" if os.name == "nt" else "bin")
PYTHON = str(BIN / "python")
STAMP = VENV / "bootstrap.json"  # written last: a .venv without it was never finished
LOCKS = {"runtime": ROOT / "requirements.lock", "dev": ROOT / "requirements-dev.lock"}

PYTHONS = ((3, 11), (3, 12), (3, 13))  # those that every locked package has a wheel for
GLIBC = (2, 35)  # Open3D's wheels are built against it

# What libOpen3D.so is linked to beyond the C library, and the packages that hold it, by package manager.
INSTALL = {
    "apt-get": "apt-get install -y --no-install-recommends",
    "dnf": "dnf install -y",
    "zypper": "zypper --non-interactive install",
    "pacman": "pacman -S --needed --noconfirm",
}
LIBRARIES = {
    "libEGL.so.1": ("libegl1", "libglvnd-egl", "libglvnd", "libglvnd"),
    "libGL.so.1": ("libgl1", "libglvnd-glx", "libglvnd", "libglvnd"),
    "libX11.so.6": ("libx11-6", "libX11", "libX11-6", "libx11"),
    "libidn2.so.0": ("libidn2-0", "libidn2", "libidn2-0", "libidn2"),
    "libstdc++.so.6": ("libstdc++6", "libstdc++", "libstdc++6", "gcc-libs"),
    "libudev.so.1": ("libudev1", "systemd-libs", "libudev1", "systemd-libs"),
    "libusb-1.0.so.0": ("libusb-1.0-0", "libusb1", "libusb-1_0-0", "libusb"),
    "libz.so.1": ("zlib1g", "zlib", "libz1", "zlib"),
}


class Stop(Exception):
    """The end of the run: what to tell the user, and the exit status."""

    def __init__(self, message: str, status: int = 2) -> None:
        super().__init__(message)
        self.status = status


def say(text: str) -> None:
    print(f"bootstrap: {text}", flush=True)


def child_environment() -> dict[str, str]:
    """This process's environment with .venv activated, and without what would lead Python elsewhere."""
    astray = ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP", "PYTHONUSERBASE", "__PYVENV_LAUNCHER__")
    env = {name: value for name, value in os.environ.items() if name not in astray}
    path = os.pathsep.join([str(BIN), env.get("PATH", os.defpath)])
    return {**env, "PATH": path, "VIRTUAL_ENV": str(VENV), "PYTHONNOUSERSITE": "1", "PIP_USER": "0"}


def attempt(command: list[str]) -> tuple[bool, str]:
    """Whether the command succeeded, and its output."""
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=child_environment()
        )
    except OSError as error:
        return False, str(error)
    return done.returncode == 0, done.stdout.decode(errors="replace")


def version_of(python: list[str]) -> str | None:
    """Such as "3.12", of a Python that runs (a version manager's shim may be there and not run)."""
    good, output = attempt([*python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"])
    return output.split()[-1] if good and output.strip() else None


def other_python(running: tuple[int, int]) -> list[str] | None:
    """The command of a supported Python, if the running one is not; None to go on with the running one."""
    for major, minor in () if running in PYTHONS else reversed(PYTHONS):
        for command in ([f"python{major}.{minor}"], ["py", f"-{major}.{minor}"]):
            if shutil.which(command[0]) and version_of(command) == f"{major}.{minor}":
                return command
    if running < PYTHONS[0]:
        raise Stop(f"this is Python {running[0]}.{running[1]}; install Python 3.11, 3.12 or 3.13 and use that one")
    if running > PYTHONS[-1]:
        say(f"Python {running[0]}.{running[1]} is newer than those this project is tested with; trying it")
    return None


def glibc() -> tuple[int, ...]:
    """The version of the GNU C library; empty where there is none."""
    name, version = platform.libc_ver()
    return tuple(int(number) for number in version.split(".")[:2]) if name == "glibc" else ()


def missing_libraries() -> list[str]:
    missing = []
    for name in LIBRARIES if sys.platform.startswith("linux") else ():
        try:
            ctypes.CDLL(name)
        except OSError:
            missing.append(name)
    return missing


def base_python() -> str:
    """The interpreter to make .venv with: the running one, or where that is a virtual environment's, the one below."""
    return getattr(sys, "_base_executable", None) or sys.executable


def missing_parts(making_venv: bool) -> tuple[list[str], dict[str, list[str]]]:
    """What the system lacks, and the packages that have it, for every package manager."""
    missing = missing_libraries()
    packages = {manager: sorted({LIBRARIES[name][i] for name in missing}) for i, manager in enumerate(INSTALL)}
    if making_venv and not attempt([base_python(), "-m", "ensurepip", "--version"])[0]:
        missing.append("Python's venv module")
        packages["apt-get"].append(f"python3.{sys.version_info[1]}-venv")  # Debian alone packages it apart
    return missing, {manager: names for manager, names in packages.items() if names}


def remedies(packages: dict[str, list[str]]) -> list[str]:
    """The line that installs the packages with the manager found here; with none found, a line for each."""
    here = [manager for manager in packages if shutil.which(manager)][:1]
    return [f"sudo {INSTALL[manager]} {' '.join(packages[manager])}" for manager in here or packages]


def ensure_machine(making_venv: bool) -> None:
    """Install what is missing with apt-get where that needs no answer from anybody; else stop with the line to type."""
    if glibc() and glibc() < GLIBC:
        raise Stop("Open3D needs glibc 2.35 (Debian 12, Ubuntu 22.04, Fedora 36) or newer; this system's is older")
    missing, packages = missing_parts(making_venv)
    root = [] if getattr(os, "geteuid", lambda: 1)() == 0 else ["sudo", "-n"]
    if missing and "apt-get" in packages and shutil.which("apt-get") and attempt([*root, "true"])[0]:
        say(f"missing: {', '.join(missing)}; installing {' '.join(packages['apt-get'])} with apt-get")
        apt = [*root, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-qq", "-o", "DPkg::Lock::Timeout=120"]
        _, updated = attempt([*apt, "update"])
        good, installed = attempt([*apt, "install", "-y", "--no-install-recommends", *packages["apt-get"]])
        if not good:
            print(updated + installed, end="", flush=True)
        missing, packages = missing_parts(making_venv)
    if missing:
        raise Stop("\n  ".join([f"missing: {', '.join(missing)}; install with", *remedies(packages)]))


def fingerprint() -> dict[str, str | None]:
    """What an environment depends on: its place, its Python (None if that does not run), the locks, the project."""
    files = {**LOCKS, "project": ROOT / "pyproject.toml"}
    digests = {key: hashlib.sha256(path.read_bytes()).hexdigest() for key, path in files.items()}
    return {"place": str(VENV), "python": version_of([PYTHON]), **digests}


def read_stamp() -> dict[str, str | None]:
    try:
        stamp = json.loads(STAMP.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return stamp if isinstance(stamp, dict) else {}


def plan(stamp: dict[str, str | None], now: dict[str, str | None], dev: bool) -> list[str]:
    """The steps that bring the environment of that stamp up to now: of "venv", "packages", "project"."""
    same = now["python"] is not None and all(stamp.get(key) == now[key] for key in ("place", "python", "runtime"))
    if not same or stamp.get("dev") not in (None, now["dev"]):
        return ["venv", "packages", "project"]
    steps = ["packages"] if dev and stamp.get("dev") is None else []
    return steps + (["project"] if stamp.get("project") != now["project"] else [])


def make_venv() -> None:
    say(f"making .venv{' anew' if VENV.exists() else ''} with Python {platform.python_version()}")
    good, output = attempt([base_python(), "-m", "venv", "--clear", str(VENV)])
    if not good:
        raise Stop(f"could not make .venv:\n{output}", 1)


def pip_install(*arguments: str) -> None:
    """pip, with a line for each large package, and its own output only if it fails."""
    command = [PYTHON, "-u", "-m", "pip", "install", "--disable-pip-version-check", "--no-input", "--no-deps"]
    lines, began = [], time.monotonic()
    command += arguments
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=child_environment()) as pip:
        for raw in pip.stdout or ():
            lines.append(raw.decode(errors="replace"))
            large = re.search(r"Downloading (?:\S*/)?(\w[\w.]*)-\S+ \((\d{2,}(?:\.\d)?) MB\)", lines[-1])
            if large:
                say(f"{time.monotonic() - began:6.0f} s  fetching {large[1]}, {large[2]} MB")
            elif re.match("Installing collected packages: .*,", lines[-1]):
                say(f"{time.monotonic() - began:6.0f} s  unpacking")
    if pip.returncode != 0:
        print("".join(lines[-40:]), end="", flush=True)
        wheels = "Wheels exist for Linux on x86-64 and aarch64, macOS on arm64, Windows on x86-64."
        raise Stop(f"pip failed, as above. If the network did, run this again: what was fetched is kept. {wheels}", 1)


def ensure_environment(dev: bool) -> None:
    stamp, began = read_stamp(), time.monotonic()
    steps = plan(stamp, fingerprint(), dev)
    ensure_machine("venv" in steps)
    if not steps:
        return
    STAMP.unlink(missing_ok=True)
    if "venv" in steps:
        make_venv()
    if "packages" in steps:
        lock = LOCKS["dev" if dev else "runtime"]
        count = len(re.findall(r"^\w[\w.-]*==", lock.read_text(encoding="utf-8"), re.MULTILINE))
        say(f"installing about {count} packages from {lock.name} (0.5 GB to fetch, the first time only)")
        pip_install("--require-hashes", "--only-binary", ":all:", "-r", str(lock))
    pip_install("--no-build-isolation", "--editable", str(ROOT))
    now = fingerprint()
    if not dev and ("venv" in steps or stamp.get("dev") is None):
        now["dev"] = None
    STAMP.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    say(f".venv is ready, after {time.monotonic() - began:.0f} s")


def doctor() -> int:
    stamp = read_stamp()
    steps = plan(stamp, fingerprint(), dev=False)
    missing, packages = missing_parts("venv" in steps)
    tools = "with" if stamp.get("dev") else "without"
    findings = [
        (sys.version_info[:2] in PYTHONS, f"Python {platform.python_version()}, {sys.executable}"),
        (not glibc() or glibc() >= GLIBC, f"C library: {' '.join(platform.libc_ver()).strip() or 'not glibc'}"),
        (not missing, f"system: {'missing ' + ', '.join(missing) if missing else 'nothing missing'}"),
        (not steps, f".venv: {'to do: ' + ', '.join(steps) if steps else f'ready, {tools} development tools'}"),
    ]
    lines = [f"{'ok    ' if good else 'NOT OK'}  {text}" for good, text in findings]
    print("\n        ".join(["\n".join(lines), *remedies(packages)]))
    return 0 if all(good for good, _ in findings) else 2


def main(arguments: list[str]) -> int:
    command, rest = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    if command in ("-h", "--help", "help"):
        print(__doc__)
        return 0
    if command not in ("demo", "test", "install", "wheelset", "doctor"):
        raise Stop(f"no command {command!r}; the commands are demo, test, install, wheelset and doctor (see --help)")
    other = other_python(sys.version_info[:2])
    if other:
        return subprocess.call([*other, str(ROOT / "bootstrap.py"), *arguments])
    if command == "doctor":
        return doctor()
    if command == "install" and rest not in ([], ["--dev"]):
        raise Stop("install takes --dev or nothing")
    ensure_environment(dev=command == "test" or (command == "install" and bool(rest)))
    script = {
        "install": [],
        "demo": [str(BIN / "wheelset"), "demo"],
        "wheelset": [str(BIN / "wheelset")],
        "test": [PYTHON, str(ROOT / ".ci" / "checks.py")],
    }[command]
    return subprocess.call([*script, *rest], env=child_environment()) if script else 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except Stop as stop:
        print(f"bootstrap: {stop}", file=sys.stderr)
        sys.exit(stop.status)
    except KeyboardInterrupt:
        sys.exit(130)
