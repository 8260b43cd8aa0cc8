"""How old y is when the host has it over OPC UA: by a cyclic read, and by a subscription of the same period.

On the secured ball of asyncua, and on node-opcua where NODE_PATH has it; both on this computer, whose clock stamps y
at its source and takes the arrival. ``FAST_S=30`` for so long each; 10 s where nothing is said.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC
from pathlib import Path
from typing import Any

import numpy as np
from asyncua.common.node import Node

from autotune.config.rig import OpcUaSettings
from drivers.opcua import OpcUaLink
from tests.benchmarks.fast_cycles import served
from tests.drivers.test_foreign_opcua import described, serving
from tests.drivers.test_opcua import ball, certificates_of_the_page
from tests.drivers.test_rig_commands import free_port

PERIODS_S = (0.1, 0.05, 0.02)


def age_s(value: Any) -> float:
    """Return how long ago the server's source took a value [s]."""
    return time.time() - float(value.SourceTimestamp.replace(tzinfo=UTC).timestamp())


class Listener:
    """Keeps the age of every value that a subscription brings."""

    def __init__(self) -> None:
        self.ages: list[float] = []

    def datachange_notification(self, node: Node, value: Any, data: Any) -> None:
        """Take a value."""
        self.ages.append(age_s(data.monitored_item.Value))


async def by_subscription(link: OpcUaLink, period_s: float, seconds: float) -> list[float]:
    """Return the ages of the values of a subscription [s]."""
    assert link._client is not None
    listener = Listener()
    subscription = await link._client.create_subscription(1e3 * period_s, listener)
    await subscription.subscribe_data_change(link._nodes["y"], sampling_interval=1e3 * period_s)
    await asyncio.sleep(seconds)
    await subscription.delete()
    return listener.ages


def by_reads(link: OpcUaLink, period_s: float, seconds: float) -> list[float]:
    """Return the ages of values that were read every period [s]."""
    ages, deadline_s = [], time.monotonic()
    for _ in range(round(seconds / period_s)):
        deadline_s += period_s
        time.sleep(max(0.0, deadline_s - time.monotonic()))
        ages.append(age_s(link._exchange(lambda: link._read(["y"]))[0][0]))
    return ages


@contextmanager
def asyncua_server(folder: Path) -> Iterator[OpcUaSettings]:
    """Serve the shipped ball, secured, in a process of its own."""
    certificates_of_the_page(folder)
    config = ball(folder)
    assert isinstance(config.rig, OpcUaSettings)
    with served(folder):
        yield config.rig


@contextmanager
def node_server(folder: Path) -> Iterator[OpcUaSettings]:
    """Serve the controller of the foreign tests."""
    port = free_port()
    with serving(certificates_of_the_page(folder), port):
        config = described((folder, port), folder)
        assert isinstance(config.rig, OpcUaSettings)
        yield config.rig


def main() -> None:
    """Print a line for each server, period and way."""
    seconds = float(os.environ.get("FAST_S", "10"))
    node = shutil.which("node")
    has_node = (
        node is not None and not subprocess.run([node, "-e", 'require("node-opcua")'], capture_output=True).returncode
    )
    for name, server in (("asyncua", asyncua_server), *((("node-opcua", node_server),) if has_node else ())):
        with tempfile.TemporaryDirectory() as folder, server(Path(folder)) as settings:
            link = OpcUaLink(settings, exclusive=False)
            link.connect()
            for period_s in PERIODS_S:
                listened = link._ask(by_subscription(link, period_s, seconds), seconds + 30.0)
                for way, ages in (("read", by_reads(link, period_s, seconds)), ("subscription", listened)):
                    low, high = 1e3 * np.quantile(ages, (0.5, 0.99))
                    print(
                        f"{name}, {1e3 * period_s:g} ms, {way}: y is {low:.1f} ms old, {high:.1f} ms in 99 %, of"
                        f" {len(ages)} values in {seconds:g} s; load average {os.getloadavg()[0]:.1f}",
                        flush=True,
                    )
            link.disconnect()


if __name__ == "__main__":
    main()
