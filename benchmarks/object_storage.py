"""`python -m benchmarks.object_storage`: what a small campaign asks of object storage, counted by an S3-compatible server.

Counts do not depend on how busy the machine is; seconds do, and are told only beside those of the same run on a disk.
Needs the development packages (moto's server).
"""

from __future__ import annotations

import argparse
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from warehouse.pool import one_thread

REQUEST = re.compile(r'"(?:\x1b\[[0-9;]*m)*(GET|HEAD|PUT|POST|DELETE) (\S+) HTTP')
BUCKET = "benchmark"


class Server:
    """moto's server on the loopback, with its access log."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self.log = folder / "requests.log"
        with self.log.open("wb") as log:
            command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
            self.process = subprocess.Popen(command, stdout=log, stderr=log)
        os.environ |= {
            "AWS_ACCESS_KEY_ID": "x",
            "AWS_SECRET_ACCESS_KEY": "x",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        }
        for _ in range(600):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    return
            time.sleep(0.1)
        raise RuntimeError(f"the server does not start: {self.log.read_text()}")

    def requests(self) -> Counter[str]:
        """Requests so far: listings apart from reads."""
        found: Counter[str] = Counter()
        for method, target in REQUEST.findall(self.log.read_text(errors="replace")):
            listing = method == "GET" and "list-type=2" in target
            found["LIST" if listing else method] += 1
        return found


def measure(wheelsets: int, days: int, repeats: int, frames: int, rows: int) -> dict[str, Any]:
    """Requests and bytes of a first run, of one with nothing to do, and of a query; seconds beside those on a disk."""
    from pipelines.ask import query
    from pipelines.runner import run
    from pipelines.settings import settings
    from warehouse import place
    from wheelset_assets.simulation import SimulationPlan, simulate

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        server = Server(folder)
        try:
            plan = SimulationPlan(
                out=folder / "inbox", wheelsets=wheelsets, days=days, repeats=repeats, seed=1, frames=frames, rows=rows
            )
            scans = simulate(plan).n_scans
            started = time.perf_counter()
            run(settings(folder / "inbox", folder / "warehouse", workers=1))
            on_disk = time.perf_counter() - started
            inbox, warehouse = (place.place(f"s3://{BUCKET}/{name}") for name in ("inbox", "warehouse"))
            files = place.filesystem(inbox)
            files.mkdir(BUCKET)
            files.put(f"{folder / 'inbox'}/", place.key(inbox), recursive=True)
            s = settings(inbox, warehouse, workers=1)
            steps: dict[str, Any] = {}
            for name, action in (
                ("first run", lambda: run(s)),
                ("run with nothing to do", lambda: run(s)),
                ("query over measurements", lambda: query(warehouse, "SELECT avg(value) FROM measurements")),
            ):
                before, started = server.requests(), time.perf_counter()
                action()
                steps[name] = {"seconds": round(time.perf_counter() - started, 2)} | dict(server.requests() - before)
            facts = place.objects(warehouse)
            by_table = Counter(name.partition("/")[0] for name in facts)
            return {
                "scans": scans,
                "days": days,
                "frames": frames,
                "rows": rows,
                "seconds_on_disk": round(on_disk, 2),
                "steps": steps,
                "objects": len(facts),
                "objects_by_table": dict(by_table.most_common()),
                "bytes": sum(f["size"] for f in facts.values()),
            }
        finally:
            server.process.kill()
            server.process.wait()


def main() -> None:
    """Measure and print one JSON document."""
    one_thread()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("wheelsets", 2), ("days", 2), ("repeats", 2), ("frames", 24), ("rows", 192)):
        parser.add_argument(f"--{name}", type=int, default=default)
    print(json.dumps(measure(**vars(parser.parse_args())), indent=1))


if __name__ == "__main__":
    main()
