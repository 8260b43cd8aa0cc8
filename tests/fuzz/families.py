"""Families of damaged inputs, each with the commands that read them."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.containers import fmus, journals, parquet, workbooks
from tests.fuzz.damage import damaged_bytes, damaged_content, damaged_csv, damaged_json, damaged_toml
from tests.fuzz.edges import edges
from tests.fuzz.sound import (
    CAMPAIGN,
    CONFIG,
    CONTROLLER,
    DESIGN,
    MODEL,
    PENDULUM,
    POINTS,
    PROGRESS,
    RATIONAL,
    RECORDING,
    Call,
    put,
    sound_files,
)


@dataclass(frozen=True, kw_only=True)
class Family:
    """One kind of input: how one is made in a folder, and its share of a campaign."""

    name: str
    make: Callable[[random.Random, Path], Call]
    share: float


def models(rng: random.Random, folder: Path) -> Call:
    """Models: margins of a loop with one, or its simulation."""
    sound = sound_files(folder)
    model = put(folder, "model.toml", damaged_toml(rng, MODEL if rng.random() < 0.7 else PENDULUM))
    if rng.random() < 0.75:
        return ["margins", "--model", model, "--controller", sound["controller"], "--out", sound["out"]]
    return ["simulate", "--model", model, sound["recording"], "--out", sound["out"]]


def controllers(rng: random.Random, folder: Path) -> Call:
    """Controllers: their margins, a maker's form, their law as code."""
    sound = sound_files(folder)
    controller = put(folder, "c.toml", damaged_toml(rng, CONTROLLER if rng.random() < 0.6 else RATIONAL))
    if rng.random() < 0.6:
        return ["margins", "--model", sound["model"], "--controller", controller, "--out", sound["out"]]
    form = rng.choice(("isa", "parallel", "series", "velocity", "percent", "c", "st"))
    return ["controller", "--controller", controller, "--form", form, "--out", sound["out"]]


def designs(rng: random.Random, folder: Path) -> Call:
    """Designs that are handed to a rig."""
    sound = sound_files(folder)
    design = put(folder, "design.json", damaged_json(rng, DESIGN))
    out = str(folder / "gains")
    return ["deploy", sound["config"], "--design", design, "--no-verify", "--yes", "--out", out]


def configs(rng: random.Random, folder: Path) -> Call:
    """Configurations: what may be run, run for two seconds of rig time."""
    config = put(folder, "config.toml", damaged_toml(rng, CONFIG))
    if rng.random() < 0.12:
        return ["run", config, "--dry-run", "--no-verify", "--out", str(folder / "run")]

    def look() -> object:
        from autotune.cli.common import rig_of
        from autotune.config import load_config

        return rig_of(load_config(config))

    return look


def campaigns(rng: random.Random, folder: Path) -> Call:
    """Campaigns: what is asked of which loop."""
    put(folder, "r.csv", RECORDING)
    campaign = put(folder, "campaign.toml", damaged_toml(rng, CAMPAIGN))

    def look() -> object:
        from autotune.batch.settings import read_campaign

        return read_campaign(campaign)

    return look


def point_files(rng: random.Random, folder: Path) -> Call:
    """Points: their reduced model, a design on them."""
    sound = sound_files(folder)
    given = put(folder, "points.json", damaged_json(rng, POINTS))
    if rng.random() < 0.9:
        return ["reduce", "--points", given, "--out", sound["out"]]
    return ["design", "--points", given, "--noise-gain", "5", "--out", sound["out"]]


def recordings(rng: random.Random, folder: Path) -> Call:
    """Recordings: simulated, identified, imported."""
    sound = sound_files(folder)
    given = put(folder, "r.csv", damaged_csv(rng, RECORDING))
    if rng.random() < 0.2:
        put(
            folder,
            "r.toml",
            damaged_toml(rng, {"units": {"u": "V"}, "controller": {"kind": "PI", "K": 1.0}, "hold": "zero"}),
        )
    way = rng.random()
    if way < 0.75:
        return ["simulate", "--model", sound["model"], given, "--out", sound["out"]]
    if way < 0.9:
        return ["identify", "frequency", given, "--out", sound["out"]]
    return ["import", given, "--out", str(folder / "imported.csv")]


def structure(rng: random.Random, folder: Path) -> Call:
    """Recordings whose times leap, stand still, turn back or repeat, to every command that fits."""
    lines = RECORDING.splitlines()
    rows = [[float(cell) for cell in line.split(",")] for line in lines[1:]]
    for _ in range(rng.choice((1, 1, 2))):
        k, way = rng.randrange(len(rows)), rng.random()
        if way < 0.4:
            leap = rng.choice((0.05, 1.0, 1e2, 1e4, 1e6, 1e9, 1e15, -1.0))
            rows[k:] = [[t + leap, u, y] for t, u, y in rows[k:]]
        elif way < 0.55:
            rows[k:k] = rows[k : k + rng.choice((1, 2, 60))]
        elif way < 0.7:
            rows = [[t * rng.choice((1e-9, 1e-3, 1e3, 1e9)), u, y] for t, u, y in rows]
        elif way < 0.85:
            del rows[k : k + rng.choice((1, 30, 200))]
        else:
            rows[k:] = rows[k:][::-1]
    given = put(folder, "r.csv", "\n".join([lines[0], *(f"{t:.15g},{u:.6g},{y:.6g}" for t, u, y in rows)]) + "\n")
    out, law = str(folder / "out.json"), sound_files(folder)["model"]
    commands = (
        ["simulate", "--model", law], ["identify", "frequency"], ["identify", "delay", "--order", "1"],
        ["identify", "closed-loop"], ["watch", "--order", "1"], ["diagnose", "--routine"], ["import"], ["tune"],
    )  # fmt: skip
    return [*rng.choice(commands), given, "--out", out.removesuffix(".json") if rng.random() < 0.5 else out]


def stories(rng: random.Random, folder: Path) -> Call:
    """The live page of a run whose files are damaged: everything that it shows."""
    lines = [json.dumps(event).encode() for event in PROGRESS]
    for _ in range(rng.choice((1, 2, 4))):
        i = rng.randrange(len(lines))
        if rng.random() < 0.7:
            lines[i] = json.dumps(damaged_content(rng, PROGRESS[i])).encode()
        else:
            lines[i] = damaged_bytes(rng, lines[i])
    put(folder, "progress.jsonl", b"\n".join(lines) + b"\n")
    put(folder, "recording.csv", damaged_csv(rng, RECORDING) if rng.random() < 0.5 else RECORDING)
    put(folder, "recording.toml", damaged_toml(rng, {"ended": {"reason": "completed", "output": "safe output"}}))

    def show() -> object:
        from autotune.live.charts import Pictures
        from autotune.live.page import _gain_rows
        from autotune.live.story import Story

        story = Story(folder)
        story.poll()
        pictures = Pictures(story)
        drawn = json.dumps([pictures.strip(60.0), pictures.strip(float("inf")), pictures.facts()], default=repr)
        said = (story.relay_text(), story.limits_text(), story.warnings(), story.remaining_s, story.decision_s)
        return drawn, said, story.outcome_text(), _gain_rows(story)

    return show


PLACES = (
    "/proc/out.json",
    "/dev/full",
    "no_folder\0/out",
    "x" * 300,
    "sound_model.toml/out",
    ".",
    "sound_model.toml",
    "/dev/null/x",
)


def outputs(rng: random.Random, folder: Path) -> Call:
    """Places that cannot be written, or hold something already."""
    sound = sound_files(folder)
    place = rng.choice(PLACES)
    out = place if place.startswith("/") else str(folder / place)
    commands = (
        ["schema"],
        ["margins", "--model", sound["model"], "--controller", sound["controller"]],
        ["controller", "--controller", sound["controller"], "--form", "isa"],
        ["simulate", "--model", sound["model"], sound["recording"]],
        ["reduce", "--points", sound["points"]],
        ["identify", "frequency", sound["recording"]],
        ["identify", "delay", sound["recording"], "--order", "1"],
        ["tune", "--points", sound["points"], "--noise-gain", "5"],
        ["run", sound["config"], "--dry-run", "--no-verify"],
        ["diagnose", "--model", sound["model"], sound["recording"]] if place != "." else ["schema"],
    )
    return [*rng.choice(commands), "--out", out]


ODD = ("nan", "inf", "-1", "0", "2", "1e308", "1e-308", "x", "", "-0.0", "1_0")


def options(rng: random.Random, folder: Path) -> Call:
    """Sound files with options that are out of their range."""
    sound = sound_files(folder)
    odd = rng.choice(ODD)
    commands = (
        ["design", "--points", sound["points"], rng.choice(("--modulus-margin", "--phase-margin", "--noise-gain"))],
        ["design", "--model", sound["model"], rng.choice(("--delay-margin", "--noise-frequency"))],
        ["margins", "--model", sound["model"], "--controller", sound["controller"], "--noise-frequency"],
        ["reduce", "--points", sound["points"], rng.choice(("--static-gain", "--static-gain-sd"))],
        ["simulate", "--model", sound["model"], sound["recording"], "--horizon"],
        ["identify", "frequency", sound["recording"], "--largest-sd"],
        ["controller", "--controller", sound["controller"], "--form", rng.choice(("velocity", "c", "st", "percent")),
         rng.choice(("--sample-time", "--u-span", "--y-span", "--u-min", "--u-max", "--u-rate"))],
    )  # fmt: skip
    return [*rng.choice(commands), odd, "--out", sound["out"]]


FAMILIES = (
    Family(name="models", make=models, share=0.14),
    Family(name="controllers", make=controllers, share=0.14),
    Family(name="designs", make=designs, share=0.06),
    Family(name="configs", make=configs, share=0.14),
    Family(name="campaigns", make=campaigns, share=0.04),
    Family(name="points", make=point_files, share=0.08),
    Family(name="recordings", make=recordings, share=0.1),
    Family(name="structure", make=structure, share=0.04),
    Family(name="workbooks", make=workbooks, share=0.06),
    Family(name="parquet", make=parquet, share=0.06),
    Family(name="fmus", make=fmus, share=0.05),
    Family(name="journals", make=journals, share=0.03),
    Family(name="live story", make=stories, share=0.08),
    Family(name="outputs", make=outputs, share=0.02),
    Family(name="options", make=options, share=0.02),
    Family(name="edges", make=edges, share=0.04),
)
