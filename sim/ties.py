"""Ties: a servo with one thing left out of its nominal model, and a recording too gentle to tell which.

    tau dv/dt = -v + K (w + force(x, v)),  x' = v,  w the command after the actuator's effects

in steps of 2 ms, with K and tau of the nominal model wrong by up to 15 %. What is left out is drawn from a range that a
gentle recording hardly shows; the same servo, with other noise, is the rig on which an experiment may decide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.whole import write_text

GAIN, TAU, NOISE = 5.4, 0.23, 0.01
CONTROLLER_GAIN, SAMPLE_TIME_S, ROWS, HELD_ROWS = 0.9, 0.02, 700, 100
#: What is left out, and the range of its size.
LEFT_OUT = {
    "actuator.dead_zone": (0.03, 0.08),
    "actuator.backlash": (0.03, 0.1),
    "actuator.nonlinear_gain": (0.1, 0.3),
    "plant.coulomb_friction": (0.01, 0.03),
    "plant.quadratic_drag": (0.01, 0.03),
    "plant.cubic_stiffness": (0.02, 0.06),
}
#: Names that are right as well: Coulomb friction is Stribeck's with nothing at low speed.
ALSO = {"plant.coulomb_friction": frozenset(("plant.stribeck_friction",))}
MODEL = """name = "servo"
[input]
unit = "V"
[output]
unit = "rad"
[[block]]
name = "mass"
place = "plant"
num = [{gain:.6g}]
den = [{tau:.6g}, 1.0]
[[block]]
name = "position"
place = "plant"
num = [1.0]
den = [1.0, 0.0]
"""
CONFIG = f"""name = "servo"
[rig]
kind = "simulated"
plant = "servo"
[signals]
sample_time_s = {SAMPLE_TIME_S}
u_unit = "V"
y_unit = "rad"
[limits]
u_min = -5.0
u_max = 5.0
u_safe = 0.0
y_min = -4.0
y_max = 4.0
swing = 3.5
time_s = 120.0
[operating_point]
y = 0.0
u_guess = 0.0
u_uncertainty = 0.3
approach = "hold"
[controller]
K = {CONTROLLER_GAIN}
Ti_s = 5.0
"""


@dataclass(frozen=True, kw_only=True)
class Tie:
    """What is left out, its size, and the names that are right."""

    left_out: str
    size: float
    seed: int

    @property
    def names(self) -> frozenset[str]:
        """Names that are right."""
        return frozenset((self.left_out,)) | ALSO.get(self.left_out, frozenset())

    def rig(self) -> Servo:
        """Return the servo at rest, for an experiment."""
        return Servo(self.left_out, self.size, self.seed + 1)


class Servo:
    """The servo with what is left out; see :class:`sim.plant.Plant`."""

    def __init__(self, left_out: str, size: float, seed: int) -> None:
        self._left_out, self._size = left_out, size
        self._v = self._x = self._play = 0.0
        self.time_s = self.u_applied = self.u_rest = 0.0
        self._random = np.random.default_rng(seed)

    @property
    def y_true(self) -> float:
        """Truth: position [rad]."""
        return self._x

    def advance(self, u: float, dt_s: float) -> None:
        """Hold a command.

        Parameters
        ----------
        u : float
            Command that is held [V].
        dt_s : float
            How long [s].
        """
        self.u_applied = u
        steps = max(1, round(dt_s / 0.002))
        faded = math.exp(-dt_s / steps / TAU)
        for _ in range(steps):
            rest = GAIN * self._push(u)
            self._x += rest * dt_s / steps + (self._v - rest) * TAU * (1.0 - faded)
            self._v = rest + (self._v - rest) * faded
        self.time_s += dt_s

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
        """Return one reading [rad]."""
        return self._x + NOISE * float(self._random.normal())

    def response(self, omega_rad_s: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Truth: G(j omega) without what is left out."""
        s = 1j * np.asarray(omega_rad_s)
        return np.asarray(GAIN / (s * (TAU * s + 1.0)), dtype=np.complex128)


def draw(seed: int) -> Tie:
    """Draw a tie; what is left out goes round with the seed."""
    left_out = list(LEFT_OUT)[seed % len(LEFT_OUT)]
    return Tie(left_out=left_out, size=float(np.random.default_rng((seed, 1)).uniform(*LEFT_OUT[left_out])), seed=seed)


def write(tie: Tie, folder: Path) -> None:
    """Write ``model.toml``, ``config.toml`` and the gentle recording ``first.csv`` of a tie with its sidecar.

    Parameters
    ----------
    tie : Tie
        What is left out, and its size.
    folder : Path
        For the files.
    """
    random = np.random.default_rng((tie.seed, 2))
    gain, tau = GAIN * random.uniform(0.85, 1.15), TAU * random.uniform(0.85, 1.15)
    write_text(folder / "model.toml", MODEL.format(gain=gain, tau=tau))
    write_text(folder / "config.toml", CONFIG)
    plant = Servo(tie.left_out, tie.size, tie.seed + 2)
    aim = np.repeat(random.uniform(-0.4, 0.4, ROWS // HELD_ROWS), HELD_ROWS)
    rows = ["t,u,y"]
    for k in range(ROWS):
        y = plant.measure()
        u = CONTROLLER_GAIN * (aim[k] - y) + 0.1 * math.sin(5.0 * k * SAMPLE_TIME_S)
        plant.advance(u, SAMPLE_TIME_S)
        rows.append(f"{k * SAMPLE_TIME_S:.2f},{u:.6g},{y:.6g}")
    write_text(folder / "first.csv", "\n".join(rows) + "\n")
    write_text(folder / "first.toml", f'[controller]\nkind = "P"\nK = {CONTROLLER_GAIN}\n')
