"""Ties: how often one experiment of the tool's choosing decides what a first, gentle recording leaves open.

A servo by its own equations, driven through the one control loop within its envelope, with one thing left out of its
nominal model, whose numbers are wrong by some percent. The first recording moves it gently; where the diagnosis is not
sure of one hypothesis after it, that is a tie, and one round of ``investigate`` is run against the whole catalogue.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from autotune.config import Config, load_config
from autotune.config.procedure import ControllerSettings
from autotune.diagnosis.investigate import Investigation, investigate
from autotune.recording import Recording
from drivers.simulated import SimulatedRig
from tests.autotune.diagnosis.servo_rigs import GAIN, TAU, servo_model

CASES = 18
CONFIG = Path(__file__).resolve().parents[2] / "configs" / "servo_sim.toml"
#: What is left out: how far each goes is drawn from a range that a gentle recording hardly shows.
TRUTHS = {
    "actuator.dead_zone": (0.03, 0.08),
    "actuator.backlash": (0.03, 0.1),
    "actuator.nonlinear_gain": (0.1, 0.3),
    "plant.coulomb_friction": (0.01, 0.03),
    "plant.quadratic_drag": (0.01, 0.03),
    "plant.cubic_stiffness": (0.02, 0.06),
}
#: Names that are right as well: Coulomb friction is Stribeck's with nothing at low speed.
ALSO = {"plant.coulomb_friction": {"plant.stribeck_friction"}}


class Servo:
    """tau dv/dt = -v + gain (w + force), in steps of 2 ms; see :class:`sim.plant.Plant`."""

    def __init__(self, left_out: str, size: float, seed: int) -> None:
        self._left_out, self._size = left_out, size
        self._v = self._x = self._play = self._u = self._t = 0.0
        self._random = np.random.default_rng(seed)

    @property
    def time_s(self) -> float:
        return self._t

    @property
    def u_applied(self) -> float:
        return self._u

    @property
    def u_rest(self) -> float:
        return 0.0

    @property
    def y_true(self) -> float:
        return self._x

    def advance(self, u: float, dt_s: float) -> None:
        self._u = u
        steps = max(1, round(dt_s / 0.002))
        faded = math.exp(-dt_s / steps / TAU)
        for _ in range(steps):
            rest = GAIN * self._push(u)
            self._x += rest * dt_s / steps + (self._v - rest) * TAU * (1.0 - faded)
            self._v = rest + (self._v - rest) * faded
        self._t += dt_s

    def _push(self, u: float) -> float:
        c, v, x = self._size, self._v, self._x
        match self._left_out:
            case "actuator.dead_zone":
                return u - min(max(u, -c), c)
            case "actuator.backlash":
                self._play = min(max(self._play, u - 0.5 * c), u + 0.5 * c)
                return self._play
            case "actuator.nonlinear_gain":
                return u + c * u**3
            case "plant.coulomb_friction":
                return u - c * math.tanh(v / 0.02)
            case "plant.quadratic_drag":
                return u - c * v * abs(v)
            case _:
                return u - c * x**3

    def measure(self) -> float:
        return self._x + 0.01 * float(self._random.normal())

    def response(self, omega_rad_s: np.ndarray) -> np.ndarray:
        s = 1j * omega_rad_s
        return np.asarray(GAIN / (s * (TAU * s + 1.0)))


def gentle(plant: Servo, seed: int, rows: int = 700, dt: float = 0.02) -> Recording:
    """Record small steps of the set-point under a P controller, with a small sine on its output."""
    random = np.random.default_rng(seed)
    aim = np.repeat(random.uniform(-0.4, 0.4, rows // 100 + 1), 100)[:rows]
    u, y = np.empty(rows), np.empty(rows)
    for k in range(rows):
        y[k] = plant.measure()
        u[k] = 0.9 * (aim[k] - y[k]) + 0.1 * math.sin(5.0 * k * dt)
        plant.advance(u[k], dt)
    return Recording(t=dt * np.arange(rows), u=u, y=y)


def config() -> Config:
    """Return the servo's configuration around zero, with room to move."""
    base = load_config(CONFIG)
    limits = {"u_min": -5.0, "u_max": 5.0, "u_safe": 0.0, "u_rate": 1e9, "y_min": -4.0, "y_max": 4.0, "swing": 3.5}
    return base.model_copy(
        update={
            "limits": base.limits.model_copy(update=limits),
            "signals": base.signals.model_copy(update={"sample_time_s": 0.02, "u_step": 0.0}),
            "operating_point": base.operating_point.model_copy(update={"y": 0.0, "u_guess": 0.0, "approach": "hold"}),
            "controller": ControllerSettings(K=0.9, Ti_s=5.0),
        }
    )


def investigated(left_out: str, seed: int) -> Investigation:
    """Run one case."""
    random = np.random.default_rng(seed)
    size = float(random.uniform(*TRUTHS[left_out]))
    model = servo_model(GAIN * random.uniform(0.85, 1.15), TAU * random.uniform(0.85, 1.15))
    rig = SimulatedRig(Servo(left_out, size, seed + 1), u_safe=0.0)
    first = gentle(Servo(left_out, size, seed + 2), seed + 3)
    with tempfile.TemporaryDirectory() as folder:
        return investigate(rig, config(), model, [first], Path(folder), rounds=1, duration_s=16.0)


def main(cases: int = CASES, seed: int = 4000, tell: Callable[[str], None] = print) -> None:
    """Print every tie with what was believed before and after its experiment, and how many were decided rightly."""
    ties = right = before = 0
    tell("| left out | believed first | experiment | believed after it |\n|---|---|---|---|")
    for i in range(cases):
        left_out = list(TRUTHS)[i % len(TRUTHS)]
        known = investigated(left_out, seed + 10 * i)
        if not known.rounds:
            continue
        ties += 1
        names = {left_out} | ALSO.get(left_out, set())
        one = known.rounds[0]
        (old, p), (new, q) = known.before[0], one.candidates[0]
        before += bool(names & set(old.split("+")))
        right += bool(names & set(new.split("+")))
        done = f"{one.plan.excitation.kind} on the {one.plan.excitation.on}"
        tell(f"| {left_out} | {old} {p:.2f} | {done} | {new} {q:.2f} |")
    tell(f"\n{cases} recordings, {ties} ties; first name right before the experiment {before}, after it {right}.")
