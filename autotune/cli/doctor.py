"""Command: is this computer ready for a rig, and how to fix what is not."""

from __future__ import annotations

import os
import platform
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console

from autotune.cli import app
from autotune.cli.common import warn_of_no_dead_man
from autotune.errors import InputError

if TYPE_CHECKING:
    from packaging.requirements import Requirement

    from autotune.config import Config

DISTRIBUTION = "relay-autotune"
#: an hour of four columns at 1 kHz is about 150 MB
SPACE_MB = 500.0
#: period that the scheduler is tried with where no configuration names one [s]
PERIOD_S = 0.01
#: share of missed deadlines from which on a run is not begun
MISSED_SHARE = 0.1

Verdict = Literal["ok", "note", "wrong"]


@dataclass(frozen=True, kw_only=True)
class Check:
    """What was looked at, what was found, and the remedy where something is wrong.

    Attributes
    ----------
    subject, found : str
        What was looked at, and what was found.
    verdict : {"ok", "note", "wrong"}
        A note lets a run go on, something wrong does not.
    remedy : str
        What to do about it.
    """

    subject: str
    found: str
    verdict: Verdict = "ok"
    remedy: str = ""


@app.command()
def doctor(
    config: Annotated[
        Path | None, typer.Argument(metavar="CONFIG.toml", help="configuration whose rig is looked for too")
    ] = None,
) -> None:
    """Check clock, ports, permissions and compiled code, and say how to fix what is wrong. Commands nothing."""
    console = Console(highlight=False, soft_wrap=True)
    wrong = []
    for check in _checks(config):
        console.print(f"{check.verdict:<5}  {check.subject}: {check.found}", markup=False)
        if check.remedy:
            console.print(f"       -> {check.remedy}", markup=False)
        if check.verdict == "wrong":
            wrong.append(check)
    if wrong:
        names = ", ".join(check.subject for check in wrong)
        raise InputError(f"not ready for a run: {names}", where="autotune doctor", remedy=wrong[0].remedy)
    console.print("ready")


def _checks(config: Path | None) -> Iterator[Check]:
    yield _python()
    yield from _packages()
    yield _extra()
    yield _check_compiled()
    yield from _writing(Path.cwd())
    content, check = _configuration(config)
    if check is not None:
        yield check
    yield from _clock()
    wanted = (content.signals.sample_time_s, content.limits.late_s) if content else (PERIOD_S, 0.15)
    yield from _scheduling(*wanted, is_needed=content is not None and _is_real(content))
    yield from _serial_ports()
    if content is not None:
        yield from _rig(content)


def _python() -> Check:
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {os.cpu_count()} processors"
    return Check(subject="Python", found=found)


def _packages() -> Iterator[Check]:
    """Compare what is installed with what the project asks for."""
    from importlib import metadata

    from packaging.requirements import Requirement

    try:
        asked = [Requirement(line) for line in metadata.requires(DISTRIBUTION) or []]
    except metadata.PackageNotFoundError:
        remedy = "pip install -e . in the project's folder"
        yield Check(subject="packages", found=f"{DISTRIBUTION} is not installed", verdict="wrong", remedy=remedy)
        return
    amiss = [_missing(one) for one in asked if one.marker is None or one.marker.evaluate({"extra": ""})]
    amiss = [words for words in amiss if words]
    if amiss:
        remedy = f"pip install --upgrade {DISTRIBUTION}, or pip install -e . in a checkout"
        yield Check(subject="packages", found="; ".join(amiss), verdict="wrong", remedy=remedy)
    else:
        yield Check(subject="packages", found=f"{DISTRIBUTION} {metadata.version(DISTRIBUTION)} and all it needs")


def _missing(asked: Requirement) -> str:
    from importlib import metadata

    try:
        version = metadata.version(asked.name)
    except metadata.PackageNotFoundError:
        return f"{asked.name} is missing"
    return "" if asked.specifier.contains(version, prereleases=True) else f"{asked.name} {version}, not {asked}"


def _extra() -> Check:
    from importlib import metadata

    from packaging.requirements import Requirement

    if _missing(Requirement("nicegui")):
        remedy = f"pip install '{DISTRIBUTION}[live]' for run --live"
        return Check(subject="live page", found="not installed", verdict="note", remedy=remedy)
    return Check(subject="live page", found=f"nicegui {metadata.version('nicegui')}")


def _check_compiled() -> Check:
    """Say whether the inner loops are compiled already, and whether they can be kept."""
    import autotune

    given, of_this = os.environ.get("NUMBA_CACHE_DIR"), f"*.py{sys.version_info.major}{sys.version_info.minor}*.nbi"
    own = Path(given) if given else Path(autotune.__file__).parent
    kept = sum(1 for _ in own.rglob(of_this)) if own.is_dir() else 0
    subject = "compiled code"
    # where the package cannot be written the compiler keeps its code in the user's cache folder
    places = [own] if given else [own, Path.home()]
    if not any(os.access(place, os.W_OK) for place in places):
        remedy = "set NUMBA_CACHE_DIR to a folder you may write; every run compiles for about half a minute otherwise"
        return Check(subject=subject, found=f"cannot be kept in {places[0]}", verdict="note", remedy=remedy)
    if not kept:
        remedy = "nothing to do: the first run compiles for about half a minute"
        return Check(subject=subject, found="none yet", verdict="note", remedy=remedy)
    return Check(subject=subject, found=f"{kept} functions kept in {own}")


def _writing(folder: Path) -> Iterator[Check]:
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            pass
    except OSError as error:
        remedy = "change to a folder you may write; recordings go there"
        yield Check(subject="write access", found=f"{folder}: {error.strerror}", verdict="wrong", remedy=remedy)
        return
    free_MB = shutil.disk_usage(folder).free / 1e6
    enough = free_MB >= SPACE_MB
    yield Check(
        subject="write access",
        found=f"{folder}, {free_MB / 1e3:.1f} GB free",
        verdict="ok" if enough else "note",
        remedy="" if enough else "a long recording may fill the disk: a sample is on disk before it is used",
    )


def _configuration(path: Path | None) -> tuple[Config | None, Check | None]:
    from autotune.config import load_config

    if path is None:
        return None, None
    try:
        content = load_config(path)
    except InputError as error:
        found = f"{error.where}: {error.what}"
        return None, Check(
            subject="configuration", found=found, verdict="wrong", remedy=error.remedy or "correct the file"
        )
    return content, Check(subject="configuration", found=f"{path}: {content.rig.kind}, {content.name}")


def _clock() -> Iterator[Check]:
    info = time.get_clock_info("perf_counter")
    subject = "clock"
    found = f"monotonic, resolution {info.resolution * 1e9:.0f} ns"
    if not info.monotonic or info.resolution > 1e-4:
        yield Check(
            subject=subject, found=found, verdict="wrong", remedy="run on a computer with a fine monotonic clock"
        )
    else:
        yield Check(subject=subject, found=found)


def _is_real(content: Config) -> bool:
    """Return whether the rig's time goes on by itself: it is not in this process."""
    from drivers.kinds import Reach, kind_of

    reach = kind_of(content.rig).reach_of(content.rig)
    return reach.address is not None or reach.device != Reach().device


def _scheduling(sample_time_s: float, late_s: float, *, is_needed: bool) -> Iterator[Check]:
    """Say what this computer does at the wanted period, and how to get real-time priority.

    Too many missed deadlines are wrong where a rig needs them.
    """
    from autotune.cli.lateness import measure_lateness, real_time_priority
    from autotune.experiment.priority import raise_priority
    from drivers.clock import MonotonicClock

    with raise_priority(MonotonicClock()):  # as a run tries it
        found = measure_lateness(sample_time_s)
    priority, how = real_time_priority()
    is_good = found.late_s <= 0.5 * found.period_s and found.worst_s <= max(late_s, 5.0 * sample_time_s)
    # a run rides through a late sample; many, or one that is too late, end it
    remedy = (
        ""
        if is_good
        else "close other programs, or let the device run the law by itself; "
        + (how or "the computer is too slow for this period: raise signals.sample_time_s")
    )
    missed = found.missed / max(found.deadlines, 1)
    verdict: Verdict = "ok" if is_good else "wrong" if is_needed and missed > MISSED_SHARE else "note"
    yield Check(subject="scheduling", found=f"{found}; {priority}", verdict=verdict, remedy=remedy)
    if is_good and how:
        yield Check(subject="real-time priority", found=f"not needed here; where it is: {how}")


def _serial_ports() -> Iterator[Check]:
    from drivers.ports import serial_ports

    found = serial_ports()
    if not found:
        yield Check(subject="serial ports", found="none")
    for port in found:
        yield _permission("serial port", port.device)


def _permission(subject: str, device: str) -> Check:
    if not Path(device).exists():
        remedy = "plug it in, or take another: autotune ports lists them"
        return Check(subject=subject, found=f"{device}: no such device", verdict="wrong", remedy=remedy)
    if os.access(device, os.R_OK | os.W_OK):
        return Check(subject=subject, found=f"{device}, may be read and written")
    remedy = f"sudo usermod -aG {_group(device)} $USER, then log in again"
    return Check(subject=subject, found=f"{device}: permission denied", verdict="note", remedy=remedy)


def _group(device: str) -> str:
    try:
        return Path(device).group()
    except (KeyError, NotImplementedError):
        return "dialout"


def _rig(content: Config) -> Iterator[Check]:
    """Look for the rig of a configuration: its device, its address, its files. Nothing is sent to it."""
    from drivers.kinds import Reach, kind_of

    reach = kind_of(content.rig).reach_of(content.rig)
    yield from (_file(name) for name in reach.files)
    if reach.address is not None:
        yield _address(*reach.address, reach.timeout_s)
    if reach.device:
        check = _permission("the rig's port", reach.device)
        yield replace(check, verdict="wrong") if check.remedy else check  # this port is needed, others are not
    if warning := warn_of_no_dead_man(content):
        what, remedy = warning.split("; ")
        yield Check(subject="dead-man", found=what, verdict="note", remedy=remedy)
    if reach == Reach():
        nothing = "nothing that could be looked for before it is opened"
        yield Check(subject="the rig", found=f'kind = "{content.rig.kind}": {nothing}')


def _file(name: str) -> Check:
    if os.access(name, os.R_OK):
        return Check(subject=name, found="may be read")
    remedy = "give its path as seen from this folder; docs/modbus_tls.md and docs/opcua.md make certificates"
    return Check(subject=name, found="cannot be read", verdict="wrong", remedy=remedy)


def _address(host: str, port: int, timeout_s: float) -> Check:
    """Open a connection and close it: no byte is sent."""
    subject = "the rig's address"
    try:
        with socket.create_connection((host, port), timeout=max(1.0, timeout_s)):
            return Check(subject=subject, found=f"{host}:{port} takes connections")
    except OSError as error:
        found = f"{host}:{port}: {error.strerror or error}"
    remedy = "switch it on, check cable and address; of a twin: start autotune rig first"
    return Check(subject=subject, found=found, verdict="wrong", remedy=remedy)
