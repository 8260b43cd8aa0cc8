"""Families of damaged inputs, each with the commands that read them."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz.damage import damaged_bytes, damaged_content, damaged_csv, damaged_json, damaged_toml

#: what is tried with an input: the words of a command, or a function that must not raise
Call = list[str] | Callable[[], object]


@dataclass(frozen=True, kw_only=True)
class Family:
    """One kind of input: how one is made in a folder, and its share of a campaign."""

    name: str
    make: Callable[[random.Random, Path], Call]
    share: float


MODEL: dict[str, Any] = {
    "name": "ball in tube",
    "input": {"unit": "V", "offset": 5.0},
    "output": {"unit": "V", "offset": 5.0},
    "block": [
        {"name": "turbine", "place": "actuator", "num": [1.0], "den": [0.016668, 1.0]},
        {
            "name": "ball speed",
            "place": "plant",
            "num": [-65.5],
            "den": [0.36359, 1.0],
            "output": "speed",
            "unit": "V/s",
        },
        {"name": "height", "place": "plant", "num": [1.0], "den": [1.0, 0.1], "delay": 0.02},
    ],
    "effect": [{"name": "actuator.dead_zone", "parameters": {"half_width": {"value": 0.01, "unit": "V", "sd": 0.001}}}],
}
PENDULUM: dict[str, Any] = {
    "name": "pendulum",
    "input": [{"column": "u", "unit": "N m"}],
    "output": {"value": "theta", "unit": "rad"},
    "state": [
        {"name": "theta", "unit": "rad", "kind": "position", "derivative": "omega"},
        {"name": "omega", "unit": "rad/s", "kind": "speed", "of": "theta", "derivative": "(u - c*omega - k*theta)/J"},
    ],
    "parameters": {
        "J": {"value": 0.05, "unit": "kg m^2"},
        "c": {"value": 0.1, "unit": "N m s"},
        "k": {"value": 1.0, "unit": "N m"},
    },
}
CONTROLLER: dict[str, Any] = {"kind": "pid", "K": -0.02, "Ti_s": 3.6, "Td_s": 0.1, "Tf_s": 0.01, "setpoint_weight": 0.8}
RATIONAL: dict[str, Any] = {"num": [1.0, 0.5], "den": [1.0, -1.0], "sample_time_s": 0.01}
DESIGN: dict[str, Any] = {
    "kind": "pi", "K": -0.024, "Ti_s": 3.6, "Td_s": 0.0, "Tf_s": 0.0, "h2": 11.0, "h2_lower_bound": None, "binding": [],
    "margins": {"modulus": 0.5}, "setpoint_weight": 1.0, "certificate": None,
}  # fmt: skip
CONFIG: dict[str, Any] = {
    "name": "ball",
    "rig": {"kind": "simulated", "plant": "ball", "seed": 1, "noise": 0.35},
    "signals": {"sample_time_s": 0.01, "u_unit": "V", "y_unit": "V", "u_step": 0.00244},
    "limits": {
        "u_min": 0.0, "u_max": 10.0, "u_safe": 0.0, "u_rate": 200.0, "y_min": 1.0, "y_max": 9.0, "swing": 3.0,
        "time_s": 2.0,
    },
    "operating_point": {"y": 5.0, "u_guess": 5.0, "u_uncertainty": 0.5, "approach": "ramp", "plant_sign": 0},
    "experiment": {"phases_deg": [-105.0, -160.0], "points": 5, "gain_sd": 0.0035, "budget_s": 5.0},
    "design": {"kind": "pi", "modulus_margin": 0.5, "phase_margin_deg": 45.0, "noise_gain": 0.1},
    "controller": {"K": -0.01, "Ti_s": 6.0},
    "verification": {"setpoint_step": 0.5, "disturbance_step": 0.1, "duration_s": 5.0},
}  # fmt: skip
CAMPAIGN: dict[str, Any] = {
    "name": "plant", "task": "design", "method": "frequency", "longest_gap_s": 10.0,
    "export": {"time": "t", "delimiter": ",", "decimal": ".", "skip_rows": 0, "quality": "{tag}.q", "good": ["Good"]},
    "design": {"kind": "pi"},
    "loop": [{"name": "FIC 1", "file": "r.csv", "u": "u", "y": "y", "u_scale": 1.0, "K": 1.0, "Ti_s": 10.0}],
}  # fmt: skip


def points() -> dict[str, Any]:
    """Return points of 2 e^(-0.3 s)/(s + 1)."""
    omega = np.geomspace(0.3, 6.0, 9)
    g = 2.0 * np.exp(-0.3j * omega) / (1j * omega + 1.0)
    return {
        "points": [
            {"omega_rad_s": w, "gain": abs(v), "phase_deg": float(np.degrees(np.angle(v))), "cov": [[s, 0.0], [0.0, s]]}
            for w, v in zip(omega.tolist(), g.tolist(), strict=True)
            for s in [(0.01 * abs(v)) ** 2]
        ]
    }


def recording(rows: int = 240) -> str:
    """Return a recording of a first-order lag under steps, with noise."""
    rng = np.random.default_rng(5)
    t, u = 0.1 * np.arange(rows), np.where(np.arange(rows) // 40 % 2, 1.0, -1.0)
    y = np.zeros(rows)
    for k in range(rows - 1):
        y[k + 1] = y[k] + 0.1 * (2.0 * u[k] - y[k])
    y += 0.01 * rng.standard_normal(rows)
    return "t,u,y\n" + "\n".join(f"{a:.6g},{b:.6g},{c:.6g}" for a, b, c in zip(t, u, y, strict=True)) + "\n"


POINTS, RECORDING = points(), recording()
PROGRESS: tuple[dict[str, Any], ...] = (
    {"event": "run", "config": {key: CONFIG[key] for key in ("name", "signals", "limits", "operating_point")}},
    {"event": "recording", "file": "recording.csv"},
    {"event": "progress", "state": "relay sweep", "elapsed_s": 3.0, "remaining_s": 4.0, "message": "point 2 of 5",
     "points": POINTS["points"], "warnings": ["beware"], "relay": {"y_centre": 5.0, "midpoint": 4.8, "amplitude": 0.1,
     "hysteresis": 0.2, "delay_samples": 10, "smoothing": 5, "plant_sign": -1}},
    {"event": "analysis", "points": POINTS["points"], "plant": {"num": [2.0], "den": [1.0, 1.0], "delay_s": 0.3},
     "reduced": {"num": [2.0], "den": [1.0, 1.0], "delay_s": 0.3}, "controller": {"K": 1.0, "Ti_s": 2.0}},
    {"event": "verification", "accepted": True, "reason": "as predicted", "steps": {
        name: [0.0, 0.5, 1.0] for name in ("t", "setpoint", "measured", "predicted", "low", "high")}},
    {"event": "gains", "old": {"K": 1.0, "Ti_s": 2.0}, "new": {"K": 1.0, "Ti_s": None}, "deployed": True},
    {"event": "waiting", "patience_s": 60.0},
    {"event": "ended", "reason": "completed", "exit_status": 0},
)  # fmt: skip


def _put(folder: Path, name: str, data: bytes | str) -> str:
    (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    return str(folder / name)


def _sound(folder: Path) -> dict[str, str]:
    """Write a sound file of every kind and return their paths."""
    import tomli_w

    return {
        "model": _put(folder, "sound_model.toml", tomli_w.dumps(MODEL)),
        "controller": _put(folder, "sound_controller.toml", 'kind = "pi"\nK = -0.02\nTi_s = 3.6\n'),
        "recording": _put(folder, "sound_recording.csv", RECORDING),
        "points": _put(folder, "sound_points.json", json.dumps(POINTS)),
        "config": _put(folder, "sound_config.toml", tomli_w.dumps(CONFIG)),
        "out": str(folder / "out.json"),
    }


def models(rng: random.Random, folder: Path) -> Call:
    """Models: margins of a loop with one, or its simulation."""
    sound = _sound(folder)
    model = _put(folder, "model.toml", damaged_toml(rng, MODEL if rng.random() < 0.7 else PENDULUM))
    if rng.random() < 0.75:
        return ["margins", "--model", model, "--controller", sound["controller"], "--out", sound["out"]]
    return ["simulate", "--model", model, sound["recording"], "--out", sound["out"]]


def controllers(rng: random.Random, folder: Path) -> Call:
    """Controllers: their margins, a maker's form, their law as code."""
    sound = _sound(folder)
    controller = _put(folder, "c.toml", damaged_toml(rng, CONTROLLER if rng.random() < 0.6 else RATIONAL))
    if rng.random() < 0.6:
        return ["margins", "--model", sound["model"], "--controller", controller, "--out", sound["out"]]
    form = rng.choice(("isa", "parallel", "series", "velocity", "percent", "c", "st"))
    return ["controller", "--controller", controller, "--form", form, "--out", sound["out"]]


def designs(rng: random.Random, folder: Path) -> Call:
    """Designs that are handed to a rig."""
    sound = _sound(folder)
    design = _put(folder, "design.json", damaged_json(rng, DESIGN))
    out = str(folder / "gains")
    return ["deploy", sound["config"], "--design", design, "--no-verify", "--yes", "--out", out]


def configs(rng: random.Random, folder: Path) -> Call:
    """Configurations: what may be run, run for two seconds of rig time."""
    config = _put(folder, "config.toml", damaged_toml(rng, CONFIG))
    if rng.random() < 0.12:
        return ["run", config, "--dry-run", "--no-verify", "--out", str(folder / "run")]

    def look() -> object:
        from autotune.cli.common import rig_of
        from autotune.config import load_config

        return rig_of(load_config(config))

    return look


def campaigns(rng: random.Random, folder: Path) -> Call:
    """Campaigns: what is asked of which loop."""
    _put(folder, "r.csv", RECORDING)
    campaign = _put(folder, "campaign.toml", damaged_toml(rng, CAMPAIGN))

    def look() -> object:
        from autotune.batch.settings import read_campaign

        return read_campaign(campaign)

    return look


def point_files(rng: random.Random, folder: Path) -> Call:
    """Points: their reduced model, a design on them."""
    sound = _sound(folder)
    given = _put(folder, "points.json", damaged_json(rng, POINTS))
    if rng.random() < 0.9:
        return ["reduce", "--points", given, "--out", sound["out"]]
    return ["design", "--points", given, "--noise-gain", "5", "--out", sound["out"]]


def recordings(rng: random.Random, folder: Path) -> Call:
    """Recordings: simulated, identified, imported."""
    sound = _sound(folder)
    given = _put(folder, "r.csv", damaged_csv(rng, RECORDING))
    if rng.random() < 0.2:
        _put(
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


def stories(rng: random.Random, folder: Path) -> Call:
    """The live page of a run whose files are damaged: everything that it shows."""
    lines = [json.dumps(event).encode() for event in PROGRESS]
    for _ in range(rng.choice((1, 2, 4))):
        i = rng.randrange(len(lines))
        if rng.random() < 0.7:
            lines[i] = json.dumps(damaged_content(rng, PROGRESS[i])).encode()
        else:
            lines[i] = damaged_bytes(rng, lines[i])
    _put(folder, "progress.jsonl", b"\n".join(lines) + b"\n")
    _put(folder, "recording.csv", damaged_csv(rng, RECORDING) if rng.random() < 0.5 else RECORDING)
    _put(folder, "recording.toml", damaged_toml(rng, {"ended": {"reason": "completed", "output": "safe output"}}))

    def show() -> object:
        from autotune.live.charts import Pictures
        from autotune.live.page import _decision, _gain_rows
        from autotune.live.story import Story

        story = Story(folder)
        story.poll()
        pictures = Pictures(story)
        drawn = json.dumps([pictures.strip(60.0), pictures.strip(float("inf")), pictures.facts()], default=repr)
        said = (story.relay_text(), story.limits_text(), story.warnings(), story.remaining_s, story.decision_s)
        return drawn, said, _decision(story), _gain_rows(story)

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
    sound = _sound(folder)
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
    sound = _sound(folder)
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
    Family(name="models", make=models, share=0.18),
    Family(name="controllers", make=controllers, share=0.18),
    Family(name="designs", make=designs, share=0.06),
    Family(name="configs", make=configs, share=0.16),
    Family(name="campaigns", make=campaigns, share=0.04),
    Family(name="points", make=point_files, share=0.12),
    Family(name="recordings", make=recordings, share=0.12),
    Family(name="live story", make=stories, share=0.1),
    Family(name="outputs", make=outputs, share=0.02),
    Family(name="options", make=options, share=0.02),
)
