"""One damaged input after the other through the command line, in worker processes whose time and memory are bounded."""

from __future__ import annotations

import contextlib
import io
import json
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import typer

from tests.fuzz.families import FAMILIES, Family
from tests.fuzz.sound import Call, sound_files

#: an input that has not been answered after this time of a processor, or after ten times as long in which the process
#: had one or waited for something else, hangs [s]
HANG_S = 20.0
#: most memory that a worker may map [byte]: what a small machine has; most by which an input lets it grow [MB]
MEMORY_BYTES, GROWTH_MB = 6 << 30, 1024.0
WELL = (0, 2, 3)


@dataclass(kw_only=True)
class Tally:
    """What became of the inputs of one family."""

    inputs: int = 0
    tracebacks: int = 0
    hangs: int = 0
    growths: int = 0
    wrong_exits: int = 0
    not_one_line: int = 0
    slowest_s: float = 0.0
    peak_mb: float = 0.0
    exits: Counter[int] = field(default_factory=Counter)

    @property
    def faults(self) -> int:
        """Inputs that were not answered well."""
        return self.tracebacks + self.hangs + self.growths + self.wrong_exits + self.not_one_line


@dataclass(frozen=True, kw_only=True)
class Answer:
    """How one input ended: what was wrong with it, empty for nothing, its exit status, and what was said."""

    family: str
    number: int
    fault: str
    status: int
    said: str
    duration_s: float
    peak_mb: float


class _Hang(BaseException):
    """An input was not answered in time."""


def _ring(*_: object) -> None:
    raise _Hang


def try_one(family: Family, number: int, seed: int, folder: Path, hang_s: float = HANG_S) -> Answer:
    """Make one input and try it in this process; 0 lets it take its time."""
    rng = random.Random(f"{seed} {family.name} {number}")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    call = family.make(rng, folder)
    began_s, before_mb = time.monotonic(), _peak_mb()
    out, err = io.StringIO(), io.StringIO()
    signal.signal(signal.SIGPROF, _ring)
    signal.setitimer(signal.ITIMER_PROF, hang_s)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = _called(call)
        fault = _fault(status, out.getvalue(), err.getvalue())
    except _Hang:
        status, fault = -1, "hang"
    except BaseException as error:
        status, fault = -1, f"traceback: {traceback.format_exception(error)[-1].strip()} {_at(error)}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    said = f"{call if isinstance(call, list) else family.name}\n{err.getvalue()[-2000:]}"
    peak_mb = _peak_mb()
    if not fault and peak_mb > before_mb + GROWTH_MB:
        fault = f"growth: {peak_mb - before_mb:.0f} MB"
    return Answer(
        family=family.name, number=number, fault=fault, status=status, said=said,
        duration_s=time.monotonic() - began_s, peak_mb=peak_mb,
    )  # fmt: skip


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _at(error: BaseException) -> str:
    frames = [
        f for f in traceback.extract_tb(error.__traceback__) if "autotune" in f.filename or "drivers" in f.filename
    ]
    return f"({Path(frames[-1].filename).name} line {frames[-1].lineno})" if frames else ""


def _called(call: Call) -> int:
    from autotune import cli
    from autotune.errors import AutotuneError

    if not isinstance(call, list):
        try:
            call()
        except AutotuneError as error:
            print(f"autotune: {error}", file=sys.stderr)
            return error.exit_status
        return 0
    if isinstance(cli.app, typer.Typer):
        cli.app = typer.main.get_command(cli.app)  # type: ignore[assignment] # once, and not anew for each input
    sys.argv = ["autotune", *call]
    try:
        cli.main()
    except SystemExit as left:
        return left.code if isinstance(left.code, int) else 1
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return 0


def _fault(status: int, out: str, err: str) -> str:
    if "Traceback" in err or "a defect of the tool" in err:
        return f"traceback: {err.strip().splitlines()[-1][:300]}"
    if status not in WELL:
        return f"wrong exit: {status}"
    if status == 0 and re.search(r"\bnan\b", out):
        return "wrong exit: a result that is not finite"
    lines = [line for line in err.splitlines() if line.startswith("autotune: ")]
    if status in (2,) and len(lines) != 1:
        return f"not one line: {len(lines)} lines for exit status {status}"
    if "Warning:" in err:
        return f"not one line: {err.strip().splitlines()[0][:200]}"
    if any(not line.isprintable() for line in lines):
        return "not one line: control characters"
    return ""


def _sound_run(_: random.Random, folder: Path) -> Call:
    out = str(folder / "run")
    return ["run", sound_files(folder)["config"], "--dry-run", "--no-verify", "--out", out]


#: inputs of a family for which what it needs is compiled
_COMPILING = dict.fromkeys(("models", "recordings", "points"), 12) | {"configs": 1}


def _work(orders: Connection, seed: int, folder: str, warm: Sequence[str]) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    os.chdir(tempfile.mkdtemp(dir=folder))
    families = {family.name: family for family in FAMILIES}
    # what compiles or loads at first takes longer than any input, and a compiler that is interrupted leaves half of it
    compiling = families | {"configs": Family(name="configs", make=_sound_run, share=0.0)}
    for name in warm:
        for number in range(_COMPILING[name]):
            try_one(compiling[name], -number - 1, 0, Path(folder) / str(os.getpid()), hang_s=0.0)
    while (order := orders.recv()) is not None:
        name, number = order
        orders.send(try_one(families[name], number, seed, Path(folder) / str(os.getpid())))


def plan(inputs: int, seed: int, names: Sequence[str] = ()) -> Iterator[tuple[str, int]]:
    """Yield family and number of every input, mixed, so that a campaign cut short has tried all families."""
    families = [family for family in FAMILIES if not names or family.name in names]
    rng = random.Random(seed)
    numbers: Counter[str] = Counter()
    for _ in range(inputs):
        name = rng.choices([f.name for f in families], [f.share for f in families])[0]
        yield name, numbers[name]
        numbers[name] += 1


class _Worker:
    def __init__(self, seed: int, folder: str, warm: Sequence[str] = ()) -> None:
        context = multiprocessing.get_context("spawn")
        self.line, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, seed, folder, warm), daemon=True)
        self.process.start()
        theirs.close()
        self.order: tuple[str, int] | None = None
        self.since_s = self.clock_s()

    def give(self, order: tuple[str, int]) -> None:
        self.order, self.since_s = order, self.clock_s()
        self.line.send(order)

    def clock_s(self) -> float:
        """Return the time, without that in which other processes had the processor that this one could have used."""
        try:
            queued_ns = int(Path(f"/proc/{self.process.pid}/schedstat").read_text(encoding="ascii").split()[1])
        except (OSError, IndexError):  # of no such process any more, or on another system
            queued_ns = 0
        return time.monotonic() - 1e-9 * queued_ns


def campaign(
    inputs: int, seconds: float, seed: int, workers: int, names: Sequence[str] = (), report: Any = None
) -> tuple[dict[str, Tally], list[Answer]]:
    """Try inputs until there are enough or the time is over.

    Parameters
    ----------
    inputs, seconds : int, float
        Most inputs, longest time [s].
    seed : int
        Every input follows from it, its family and its number.
    workers : int
        Processes.
    names : sequence of str
        Families; all when empty.
    report : callable, optional
        Told every fault as it is found.

    Returns
    -------
    tallies : dict of str to Tally
        By family.
    faults : list of Answer
        Inputs that were not answered well.
    """
    tallies: dict[str, Tally] = defaultdict(Tally)
    faults: list[Answer] = []
    orders, until_s = plan(inputs, seed, names), time.monotonic() + seconds
    with tempfile.TemporaryDirectory(prefix="autotune-fuzz-") as folder:
        pool = [_Worker(seed, folder, warm=tuple(_COMPILING) if i == 0 else ()) for i in range(workers)]
        busy = []
        for worker in pool:
            if (order := next(orders, None)) is not None:
                worker.give(order)
                busy.append(worker)
        while busy:
            wait([worker.line for worker in busy], timeout=0.1)
            for i, worker in enumerate(busy):
                answer = _answer_of(worker)
                if answer is None:
                    continue
                _count(tallies[answer.family], answer)
                if answer.fault:
                    faults.append(answer)
                    if report is not None:
                        report(answer)
                fresh = worker
                if answer.status == -9 or answer.fault.startswith("hang"):
                    worker.process.kill()
                    fresh = _Worker(seed, folder)
                order = next(orders, None) if time.monotonic() < until_s else None
                if order is None:
                    fresh.process.kill()
                    busy[i] = None  # type: ignore[call-overload]
                else:
                    fresh.give(order)
                    busy[i] = fresh
            busy = [worker for worker in busy if worker is not None]
        for worker in pool:
            worker.process.join()
    return dict(tallies), faults


def answers(orders: Sequence[tuple[str, int]], seed: int, folder: Path) -> list[Answer]:
    """Return what became of chosen inputs, tried one after the other in a process of their own."""
    warm = ("configs",) if any(name == "configs" for name, _ in orders) else ()
    worker, found = _Worker(seed, str(folder), warm), []
    try:
        for order in orders:
            worker.give(order)
            while (answer := _answer_of(worker)) is None:
                wait([worker.line], timeout=0.1)
            found.append(answer)
    finally:
        worker.process.kill()
        worker.process.join()
        worker.line.close()
    return found


def _answer_of(worker: _Worker) -> Answer | None:
    """Return what came back, a hang or a death where nothing ever will, None while it is at work."""
    assert worker.order is not None
    name, number = worker.order
    fault = ""
    try:
        if worker.line.poll():
            answer: Answer = worker.line.recv()
            return answer
    except (EOFError, ConnectionError):
        fault = "traceback: the process died"
    waited_s = worker.clock_s() - worker.since_s
    if not fault and waited_s > 10.0 * HANG_S:
        fault = "hang"
    if not fault:
        return None
    return Answer(family=name, number=number, fault=fault, status=-9, said="", duration_s=waited_s, peak_mb=0.0)


def _count(tally: Tally, answer: Answer) -> None:
    tally.inputs += 1
    tally.exits[answer.status] += 1
    tally.tracebacks += answer.fault.startswith("traceback")
    tally.hangs += answer.fault.startswith("hang")
    tally.growths += answer.fault.startswith("growth")
    tally.wrong_exits += answer.fault.startswith("wrong exit")
    tally.not_one_line += answer.fault.startswith("not one line")
    tally.slowest_s = max(tally.slowest_s, answer.duration_s)
    tally.peak_mb = max(tally.peak_mb, answer.peak_mb)


def as_json(answers: Sequence[Answer]) -> str:
    """Return faults for a file."""
    return json.dumps([vars(answer) for answer in answers], indent=1)
