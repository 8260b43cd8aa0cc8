"""One embedded cluster for all tests of this folder, and a scheduler with two workers started apart."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator

import pytest
from distributed import Client

from autotune.batch.engine import cluster


@pytest.fixture(scope="session")
def two_workers() -> Iterator[Client]:
    """Embedded cluster of two workers."""
    with cluster(workers=2) as client:
        yield client


@pytest.fixture(scope="session")
def scheduler() -> Iterator[str]:
    """Address of a scheduler that was started by its own command, with two workers started by theirs."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    words = ["scheduler", "--host", address, "--no-dashboard", "--dashboard-address", "127.0.0.1:0"]
    commands = [words, *[["worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]] * 2]
    started = [
        subprocess.Popen([sys.executable, "-m", "dask", *command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for command in commands
    ]
    try:
        yield address
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait()
