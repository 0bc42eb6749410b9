"""A real S3-compatible server on the loopback: moto's, a process of its own, with one bucket."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dask_cluster import free_port, wait_for_port

BUCKET = "wheelsets"


@contextmanager
def s3_server(folder: Path) -> Iterator[dict[str, str]]:
    """The environment that leads to the server, set for this process as long as it runs."""
    port = free_port()
    environment = {
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_CONFIG_FILE": str(folder / "none"),
        "AWS_SHARED_CREDENTIALS_FILE": str(folder / "none"),
    }
    before = {name: os.environ.get(name) for name in environment}
    with (folder / "moto.log").open("wb") as log:
        server = subprocess.Popen(
            [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)], stdout=log, stderr=log
        )
    try:
        wait_for_port(port, server)
        os.environ.update(environment)
        import s3fs

        s3fs.S3FileSystem.clear_instance_cache()  # those of an earlier server know its port
        s3fs.S3FileSystem(use_listings_cache=False).mkdir(BUCKET)
        yield environment
    finally:
        server.kill()
        server.wait()
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
