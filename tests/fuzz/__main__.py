"""``python -m tests.fuzz``: damaged inputs against the command line, a table of what became of them."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tests.fuzz.campaign import Answer, Tally, as_json, campaign
from tests.fuzz.families import FAMILIES


def main() -> int:
    """Run a campaign and print its table; the exit status says whether every input was answered well."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=50_000, help="most inputs")
    parser.add_argument("--seconds", type=float, default=600.0, help="longest time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--family", action="append", default=[], choices=[family.name for family in FAMILIES])
    parser.add_argument("--faults", type=Path, help="JSON file for the inputs that were not answered well")
    given = parser.parse_args()
    began_s = time.monotonic()
    tallies, faults = campaign(given.inputs, given.seconds, given.seed, given.workers, given.family, _say)
    _print(tallies, time.monotonic() - began_s, given.seed)
    if given.faults is not None:
        given.faults.write_text(as_json(faults), encoding="utf-8")
    return 1 if faults else 0


def _say(answer: Answer) -> None:
    print(f"{answer.family} {answer.number}: {answer.fault}", file=sys.stderr)


def _print(tallies: dict[str, Tally], took_s: float, seed: int) -> None:
    columns = (
        "inputs",
        "tracebacks",
        "hangs",
        "over 1 GB",
        "wrong exits",
        "not one line",
        "slowest [s]",
        "peak [MB]",
        "0 / 2 / 3",
    )
    print(f"| {'family':12s} | {' | '.join(columns)} |")
    print(f"|---|{'---|' * len(columns)}")
    total = Tally()
    for name in [family.name for family in FAMILIES if family.name in tallies]:
        tally = tallies[name]
        _row(name, tally)
        for key in ("inputs", "tracebacks", "hangs", "growths", "wrong_exits", "not_one_line"):
            setattr(total, key, getattr(total, key) + getattr(tally, key))
        total.exits += tally.exits
        total.slowest_s, total.peak_mb = max(total.slowest_s, tally.slowest_s), max(total.peak_mb, tally.peak_mb)
    _row("all", total)
    print(f"seed {seed}, {took_s:.0f} s")


def _row(name: str, t: Tally) -> None:
    exits = " / ".join(str(t.exits[status]) for status in (0, 2, 3))
    cells = (
        t.inputs,
        t.tracebacks,
        t.hangs,
        t.growths,
        t.wrong_exits,
        t.not_one_line,
        f"{t.slowest_s:.1f}",
        f"{t.peak_mb:.0f}",
        exits,
    )
    print(f"| {name:12s} | {' | '.join(map(str, cells))} |")


if __name__ == "__main__":
    sys.exit(main())
