"""Every check of this checkout, then its tests, in the environment that this runs in.

`python3 bootstrap.py test` makes that environment and comes here.  All run, whatever the earlier ones found, and
pytest last, so that its closing line is the last one.  The exit status is 0 only if nothing failed.
"""

import argparse
import subprocess
import sys
import sysconfig
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SCRIPTS = Path(sysconfig.get_path("scripts"))
CHECKS = {
    "lint": [["ruff", "check", "."], ["ruff", "format", "--check", "."]],
    "types": [["mypy"]],
    "contracts": [["lint-imports"]],
}
PARTS = [*CHECKS, "pytest"]
WHOLE_SUITE = ["-n", "2", "--dist", "loadfile"]
"""Two processes, a file of tests in one of them: where nothing else is said to pytest."""


def parse(arguments: list[str]) -> tuple[list[str], list[str]]:
    """The parts to run, and the arguments for pytest: those after "--"."""
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    parser = argparse.ArgumentParser(
        prog="bootstrap.py test", usage="%(prog)s [--only PART]... [-- PYTEST-ARGUMENT...]"
    )
    parser.add_argument("--only", action="append", choices=PARTS, help="this part alone (may be repeated)")
    return parser.parse_args(arguments[:cut]).only or PARTS, arguments[cut + 1 :]


def run(command: list[str]) -> bool:
    print(f"$ {' '.join(command)}", flush=True)
    return subprocess.call([str(SCRIPTS / command[0]), *command[1:]], cwd=ROOT) == 0


def main(arguments: list[str]) -> int:
    parts, pytest_arguments = parse(arguments)
    commands = [command for part in CHECKS if part in parts for command in CHECKS[part]]
    failed = [" ".join(command) for command in commands if not run(command)]
    if commands:
        print(f"FAILED: {'; '.join(failed)}" if failed else "the checks passed", flush=True)
    tested = "pytest" not in parts or run(["python", "-m", "pytest", *(pytest_arguments or WHOLE_SUITE)])
    return 0 if tested and not failed else 1


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
