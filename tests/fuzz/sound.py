"""Sound inputs of every kind, which the families damage."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

#: what is tried with an input: the words of a command, or a function that must not raise
Call = list[str] | Callable[[], object]
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
LAG = 'name = "lag"\n[[block]]\nname = "p"\nplace = "plant"\nnum = [2.0]\nden = [1.0, 1.0]\n'
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


def put(folder: Path, name: str, data: bytes | str) -> str:
    (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    return str(folder / name)


def sound_files(folder: Path) -> dict[str, str]:
    """Write a sound file of every kind and return their paths."""
    import tomli_w

    return {
        "model": put(folder, "sound_model.toml", tomli_w.dumps(MODEL)),
        "controller": put(folder, "sound_controller.toml", 'kind = "pi"\nK = -0.02\nTi_s = 3.6\n'),
        "recording": put(folder, "sound_recording.csv", RECORDING),
        "points": put(folder, "sound_points.json", json.dumps(POINTS)),
        "config": put(folder, "sound_config.toml", tomli_w.dumps(CONFIG)),
        "lag": put(folder, "sound_lag.toml", LAG),
        "out": str(folder / "out.json"),
    }
