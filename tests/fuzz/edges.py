"""Options of every command at the edges of their ranges, just beyond them, and far beyond."""

from __future__ import annotations

import math
import random
from functools import cache
from pathlib import Path
from typing import Any, get_args

import typer

from tests.fuzz.sound import Call, sound_files

ODD = ("nan", "inf", "-inf", "-1", "0", "1", "2", "1e308", "-1e308", "1e-308", "1e9", "1e-9", "x", "", "-0.0", "1_0",
       "9" * 400, "true", "0x10")  # fmt: skip


def _lines(sound: dict[str, str], folder: Path) -> list[list[str]]:
    """Return a sound call of every command that takes files and ends by itself."""
    law, model, points, recording = sound["controller"], sound["model"], sound["points"], sound["recording"]
    out, table, page = sound["out"], str(folder / "out.csv"), str(folder / "out")
    return [
        ["design", "--points", points, "--out", out], ["design", "--model", sound["lag"], "--out", out],
        ["margins", "--model", model, "--controller", law, "--out", out], ["reduce", "--points", points, "--out", out],
        ["simulate", "--model", model, recording, "--out", table], ["identify", "frequency", recording, "--out", out],
        ["identify", "delay", recording, "--out", out], ["identify", "closed-loop", recording, "--out", out],
        ["controller", "--controller", law, "--sample-time", "0.1", "--out", str(folder / "pi.c")],
        ["watch", recording, "--order", "1", "--out", table], ["tune", recording, "--out", page],
        ["rst", "--model", sound["lag"], "--dominant", "1", "--rest", "5", "--out", out],
        ["reference", "--model", sound["lag"], "--u-min", "-3", "--u-max", "3", "--out", table],
        ["validate", "--model", sound["lag"], "--against", sound["lag"], "--controller", law, "--out", out],
        ["import", recording, "--out", table], ["diagnose", "--routine", recording, "--out", page],
        ["deploy", sound["config"], "--controller", law, "--no-verify", "--yes", "--out", page],
        ["paper", "relay", "--out", page],
    ]  # fmt: skip


@cache
def _numbers(*words: str) -> list[Any]:
    """Return the options of a command that take a number."""
    from autotune import cli

    found: Any = typer.main.get_command(cli.app) if isinstance(cli.app, typer.Typer) else cli.app
    for word in words:
        found = found.commands[word]
    return [p for p in found.params if p.opts[0].startswith("--") and set(_types(p)) & {int, float}]


def _types(option: Any) -> tuple[Any, ...]:
    kind = option.type_descriptor.annotation
    return get_args(kind) or (kind,)


def _edges(option: Any) -> list[str]:
    """Return the ends of an option's range, and the numbers next to them."""
    found: list[str] = []
    for end in (option.min, option.max):
        if end is not None and int in _types(option):
            found += [str(end + by) for by in (-1, 0, 1)]
        elif end is not None:
            found += [repr(math.nextafter(end, towards)) for towards in (-math.inf, math.inf)] + [repr(float(end))]
    return found


def edges(rng: random.Random, folder: Path) -> Call:
    """Sound files with one or two numbers of the command line at an edge or beyond it."""
    line = rng.choice(_lines(sound_files(folder), folder))
    words = line[:2] if line[0] in ("identify", "paper") else line[:1]
    numbers = _numbers(*words)
    for option in rng.sample(numbers, min(len(numbers), rng.choice((1, 1, 2)))):
        if option.opts[0] in line:
            at = line.index(option.opts[0])
            del line[at : at + 2]
        value = rng.choice([*_edges(option), *ODD] if rng.random() < 0.5 else ODD)
        waits = option.opts[0] == "--follow" and value in {"1", "2", "1e9", "1_0", *_edges(option)}
        line = [*line, option.opts[0], "0" if waits else value]  # it would wait for as long as it is told
    return line
