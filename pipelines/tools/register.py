"""`wheelset tool register`: the pose of one cloud on another, without an initial guess, and what the surfaces say of it."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pipelines.options import JsonOption, print_json
from pipelines.tools import tool_app
from pipelines.tools.clouds import KINDS
from wheelset_assets.quality import AlgorithmFailed, ConfigError

if TYPE_CHECKING:
    from numpy import floating
    from numpy.typing import NDArray

    from wheelset_assets.metrology.global_registration import Registered

    Array = NDArray[floating[Any]]

REFUSED = 3
OUTLIER_SPACINGS = 4.0


@tool_app.command()
def register(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help=f"Cloud that is moved: {KINDS}")],
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="Cloud that it is moved onto; same unit of length")],
    initial: Annotated[
        Path | None,
        typer.Option("--initial", metavar="FILE", help="Pose to begin with: target_from_source, 4 x 4, text"),
    ] = None,
    method: Annotated[
        Literal["generalised", "plane", "point"],
        typer.Option("--method", help="Fine registration: generalised ICP, point-to-plane, point-to-point"),
    ] = "generalised",
    max_distance: Annotated[
        float | None,
        typer.Option(
            "--max-distance",
            metavar="LENGTH",
            help="Longest pair at the end, in the clouds' unit [default: four spacings of the coarser cloud]",
            show_default=False,
        ),
    ] = None,
    outliers: Annotated[
        Literal["none", "statistical", "radius"],
        typer.Option(
            "--outliers",
            help="Points to leave out of both clouds first: statistical, those far from their 20 nearest; radius, those "
            "with fewer than 2 others within four spacings",
        ),
    ] = "none",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write target_from_source here, 4 x 4, text")
    ] = None,
    as_json: JsonOption = False,
) -> int:
    """Register two clouds: no initial guess is needed, nor a rig.

    Keypoint-free: every point of thinned clouds gets a descriptor (FPFH), groups of matches that agree pairwise propose
    poses, the surfaces decide, ICP refines. Lengths are in the clouds' own unit. Exit code 3: no pose, and why.
    """
    from pipelines.tools.clouds import read_pose
    from wheelset_assets.metrology.global_registration import register_clouds

    if max_distance is not None and not max_distance > 0:
        raise ConfigError(f"--max-distance {max_distance}: must be positive")
    start = read_pose(initial) if initial else None
    (moved, gone), (still, also_gone) = (_cloud(place, outliers) for place in (source, target))
    began = time.monotonic()
    try:
        found = register_clouds(moved, still, start, method=method, reach=max_distance)
    except AlgorithmFailed as failure:
        if as_json:
            print_json(
                {
                    "source": str(source),
                    "target": str(target),
                    "n_outliers": gone + also_gone,
                    "target_from_source": None,
                    "reason": str(failure),
                }
            )
        print(f"wheelset: no registration: {failure}", file=sys.stderr)
        return REFUSED
    document = describe(found) | {
        "source": str(source),
        "target": str(target),
        "n_source": len(moved),
        "n_target": len(still),
        "n_outliers": gone + also_gone,
        "method": method,
        "seconds": time.monotonic() - began,
    }
    if out is not None:
        out.write_text("\n".join(" ".join(f"{v:.17g}" for v in row) for row in document["target_from_source"]) + "\n")
    if as_json:
        print_json(document)
    else:
        _show(document, out)
    return 0


def _cloud(place: Path, outliers: str) -> tuple[Array, int]:
    """A file's points without outliers, and how many these were; ConfigError where none is left."""
    from pipelines.tools.clouds import read_cloud

    points = read_cloud(place)
    kept = without_outliers(points, outliers)
    if len(points) and not len(kept):
        raise ConfigError(f"{place}: --outliers {outliers} leaves none of its {len(points)} points; leave it out")
    return kept, len(points) - len(kept)


def without_outliers(points: Array, kind: str) -> Array:
    """The cloud (n, 3) without what `--outliers` names."""
    from wheelset_assets.metrology.surface import far_from_others, lonely, spacing

    if kind == "statistical":
        return points[~far_from_others(points)]
    if kind == "radius":
        return points[~lonely(points, OUTLIER_SPACINGS * spacing(points), 2)]
    return points


def describe(found: Registered) -> dict[str, Any]:
    """The JSON document of a registration (outputs.md), with what more is known of it."""
    fine, start = found.fine, found.start
    return {
        "target_from_source": fine.target_from_source.tolist(),
        "inlier_rmse": fine.inlier_rmse,
        "fitness": fine.fitness,
        "n_constrained": fine.n_constrained,
        "information": fine.information.tolist(),
        "constraint_shares": fine.shares.tolist(),
        "n_pairs": fine.n_pairs,
        "n_iterations": fine.n_iterations,
        "converged": fine.converged,
        "max_distance": found.reach,
        "started_from": "initial" if start is None else "matches",
        "n_matches": None if start is None else start.n_matches,
        "n_matches_agreeing": None if start is None else start.n_inliers,
        "reason": None,
    }


def _show(document: dict[str, Any], out: Path | None) -> None:
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    from wheelset_assets.metrology import rigid

    pose = np.array(document["target_from_source"])
    angle = np.degrees(np.linalg.norm(rigid.vector_from_rotation(pose[:3, :3])))
    console = Console()
    print("target_from_source")
    for row in pose:
        print("  " + "  ".join(f"{v: .9f}" for v in row))
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    lines = {
        "rotation": f"{angle:.3f}°, shift {np.linalg.norm(pose[:3, 3]):.6g}",
        "inlier RMSE": f"{document['inlier_rmse']:.4g} over {document['n_pairs']:,} pairs no longer than {document['max_distance']:.4g}",
        "fitness": f"{document['fitness']:.1%} of the source's points have a partner",
        "constrained": f"{document['n_constrained']} of 6 directions",
        "started from": "the given pose"
        if document["n_matches"] is None
        else f"{document['n_matches_agreeing']} agreeing of {document['n_matches']} matches",
        "fine": f"{document['method']}, {document['n_iterations']} iterations"
        + ("" if document["converged"] else ", NOT converged"),
        "outliers left out": f"{document['n_outliers']:,}",
        "time": f"{document['seconds']:.1f} s",
    }
    for key, value in lines.items():
        table.add_row(key, value)
    console.print(table)
    if document["n_constrained"] < 6:
        print(
            "The surfaces leave some directions open (constraint_shares in --json): there the pose is where ICP began."
        )
    if out is not None:
        print(f"written to {out}")
