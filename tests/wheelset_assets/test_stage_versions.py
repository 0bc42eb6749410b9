"""A stage's version is the meaning of its algorithm: if the code behind it changes, someone must say which it was.

Either the numbers may change: raise the stage's `version` in `stages/__init__.py`. Or it was a refactoring: keep it. In
both cases accept the new source by `WHEELSET_ACCEPT=1 pytest tests/wheelset_assets/test_stage_versions.py`.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import json
import os
from pathlib import Path

from wheelset_assets.stages import STAGES

ACCEPTED = Path(__file__).with_name("stage_versions.json")


def modules(name: str, seen: dict[str, str]) -> dict[str, str]:
    """Code of a module and of what it imports from stages and metrology, by name."""
    if name in seen:
        return seen
    path = importlib.import_module(name).__file__
    assert path is not None
    source = Path(path).read_text(encoding="utf-8")
    tree = ast.parse(source)
    seen[name] = code_lines(source, tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("wheelset_assets."):
            package = node.module
            targets = [package] if package.count(".") > 1 else [f"{package}.{alias.name}" for alias in node.names]
            for target in targets:
                if target.startswith(("wheelset_assets.metrology.", "wheelset_assets.stages.")):
                    modules(target, seen)
    return seen


def code_lines(source: str, tree: ast.Module) -> str:
    """Lines of a module without docstrings, comments of their own and blank lines: the same in every Python."""
    prose = {
        line
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    kept = [line.strip() for n, line in enumerate(source.splitlines(), start=1) if n not in prose]
    return "\n".join(line for line in kept if line and not line.startswith("#"))


def fingerprint(function: object) -> str:
    """Hash of the code behind a stage."""
    found = modules(function.__module__, {})  # type: ignore[attr-defined]
    return hashlib.sha256("\n".join(f"{n}\n{found[n]}" for n in sorted(found)).encode()).hexdigest()[:16]


def test_every_change_of_a_stage_is_versioned_or_accepted() -> None:
    now = {stage.name: {"version": stage.version, "source": fingerprint(stage.run)} for stage in STAGES}
    if os.environ.get("WHEELSET_ACCEPT"):
        ACCEPTED.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    accepted = json.loads(ACCEPTED.read_text(encoding="utf-8"))
    changed = [name for name in now if now[name] != accepted.get(name)]
    assert not changed, f"{', '.join(changed)}: {__doc__}"
