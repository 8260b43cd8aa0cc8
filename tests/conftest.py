"""Shared fixtures and the rule for tests that need a system package."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# Small matrices on several cores are waited for longer than they are worked on. Workers and programs that tests start
# read this before they import numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

# one profile everywhere: the machine's load decides how long an example takes, so there is no deadline
settings.register_profile("project", deadline=None, print_blob=True)
settings.load_profile("project")

# a shell has its background jobs ignore Ctrl-C, and tests that send it would not be heard
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

#: Recordings that lie beside a checkout and never in it; tests that use them are skipped elsewhere.
SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.hookimpl(wrapper=True, optionalhook=True)
def pytest_xdist_auto_num_workers() -> Generator[None, int, int]:
    """Start one worker more than there are processors: tests of rigs on the wall clock mostly wait."""
    return (yield) + 1


@pytest.fixture
def shared() -> Path:
    """Folder of recordings beside the checkout."""
    if not SHARED.is_dir():
        pytest.skip(f"no recordings at {SHARED}")
    return SHARED


#: Debian package -> a program or file that shows it is there.
SYSTEM_PACKAGES = {
    "chromium": "chromium",
    "gcc": "gcc",
    "gcc-avr": "avr-gcc",
    "avr-libc": "/usr/lib/avr/include/avr/io.h",
    "libsimavr-dev": "/usr/include/simavr/sim_avr.h",
    "libelf-dev": "/usr/include/libelf.h",
    "socat": "socat",
    "libmodbus-dev": "/usr/include/modbus/modbus.h",
    "mbpoll": "mbpoll",
}


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test whose system package is missing, or fail it where the packages were promised."""
    for mark in item.iter_markers("system"):
        for package in mark.args:
            shows = SYSTEM_PACKAGES[package]
            if not (Path(shows).exists() if shows.startswith("/") else shutil.which(shows)):
                say = pytest.fail if os.environ.get("REQUIRE_SYSTEM_PACKAGES") else pytest.skip
                say(f"needs {package}: apt-get install {package}")


@pytest.fixture(autouse=True)
def _signals_left_alone() -> Iterator[None]:
    """No test changes who hears a signal: a Ctrl-C that a later one sends would not be heard."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    after = {number: signal.getsignal(number) for number in before}
    for number, handler in before.items():
        signal.signal(number, handler)
    assert after == before
