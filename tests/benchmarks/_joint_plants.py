"""Forty plants besides the ball, and the ball's own class violated, for sweeps that estimate their points together."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.linalg import expm
from scipy.signal import tf2ss

from autotune.arrays import ComplexArray, FloatArray
from autotune.config import Config, load_config
from autotune.models import TransferFunction

#: steps of the simulation in a sample time; dead times are whole numbers of them
STEPS = 4
#: half-width of the uniform noise over the swing: somewhat less than the ball's
NOISE = 0.08
#: samples in a period of the fastest limit cycle
SAMPLES = 80
BALL = Path(__file__).resolve().parents[2] / "configs" / "ball_sim.toml"


@dataclass(frozen=True, kw_only=True)
class Case:
    """A plant and what violates its class.

    Attributes
    ----------
    name : str
        What it is.
    plant : TransferFunction
        The linear part; gain such that the swing is 1.
    time_s : float
        Period of its fastest limit cycle [s].
    sample_time_s : float
        Control period [s].
    play : float
        Half-width of the actuator's play, over half the range of the command.
    curve : float
        Departure of the actuator's curve from a line at the ends of the range, over half of it.
    drift : float
        Change of the load over ten of the plant's times, over half the range.
    load : float
        Step of the load a while into the sweep, over half the range.
    """

    name: str
    plant: TransferFunction
    time_s: float
    sample_time_s: float
    play: float = 0.0
    curve: float = 0.0
    drift: float = 0.0
    load: float = 0.0
    load_s: float = field(default=math.inf)

    def config(self, *, together: bool) -> Config:
        """Return the configuration of a sweep on it: command 0 to 10, held at 5, y swings by 1."""
        base = load_config(BALL)
        samples = base.signals.model_copy(update={"sample_time_s": self.sample_time_s, "u_step": 0.0})
        limits = base.limits.model_copy(
            update={
                "u_safe": 5.0,
                "u_rate": 1e9,
                "y_min": -50.0,
                "y_max": 50.0,
                "swing": 1.0,
                "time_s": 400.0 * self.time_s,
                "late_s": 1e6,
            }
        )
        point = base.operating_point.model_copy(
            update={"y": 0.0, "u_guess": 5.0, "u_uncertainty": 1.2, "approach": "hold"}
        )
        experiment = base.experiment.model_copy(update={"budget_s": 200.0 * self.time_s, "together": together})
        return base.model_copy(
            update={"signals": samples, "limits": limits, "operating_point": point, "experiment": experiment}
        )


class LinearPlant:
    """A transfer function behind an actuator that may have play, a curve or a load; see :class:`sim.plant.Plant`."""

    def __init__(self, case: Case, *, seed: int) -> None:
        self._case, self._random = case, np.random.default_rng((seed, *case.name.encode()))
        self._step_s = case.sample_time_s / STEPS
        plant = case.plant
        A, B, self._C, _ = tf2ss(plant.num, plant.den)
        n = len(A)
        held = expm(self._step_s * np.block([[A, B], [np.zeros((1, n + 1))]]))
        self._F, self._g = held[:n, :n], held[:n, n]
        self._x = np.zeros(n)
        self._time_s, self._u, self._acting = 0.0, 5.0, 5.0
        self._held = deque([0.0] * (1 + round(plant.delay_s / self._step_s)))
        # half the command's range moves y by so much that a relay of a third of it swings by the limit, roughly
        self.u_rest = 5.0

    @property
    def time_s(self) -> float:
        """Time lived [s]."""
        return self._time_s

    @property
    def u_applied(self) -> float:
        """Command held."""
        return self._u

    @property
    def y_true(self) -> float:
        """Output without noise."""
        return float((self._C @ self._x)[0])

    def advance(self, u: float, dt_s: float) -> None:
        """Hold a command."""
        self._u = u
        for _ in range(round(dt_s / self._step_s)):
            case = self._case
            half = 5.0 * case.play
            self._acting = min(max(self._acting, u - half), u + half)
            way = (self._acting - 5.0) / 5.0
            load = case.load * (self._time_s >= case.load_s) + case.drift * self._time_s / (10.0 * case.time_s)
            self._held.append(5.0 * (way + case.curve * way * way + load))
            self._held.popleft()
            self._x = self._F @ self._x + self._g * self._held[0]
            self._time_s += self._step_s

    def measure(self) -> float:
        """Return a measurement."""
        return self.y_true + NOISE * float(self._random.uniform(-1.0, 1.0))

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return the response of the linear part."""
        return self._case.plant.response(np.atleast_1d(omega_rad_s))

    def gain(self, amplitude: float, midpoint: float) -> float:
        """Return what play and a curve are to a command of two levels, a gain.

        Each step goes through the play at once, so that the actuator has two levels as well: no relay of that
        amplitude can tell it from a plant of that gain.
        """
        play = 1.0 - 5.0 * self._case.play / amplitude
        return play * (1.0 + 2.0 * self._case.curve * (midpoint - 5.0) / 5.0)


def _case(name: str, num: list[float], den: list[float], delay: float, time_s: float) -> Case:
    """Return the case with the gain that lets a third of the half range swing y by 1 at the phase of -160 degrees."""
    shape = TransferFunction(num=tuple(num), den=tuple(den), delay_s=delay)
    omega = np.geomspace(1e-3, 1e3, 20000) / time_s
    response = shape.response(omega)
    phase = np.unwrap(np.angle(response))
    phase += 2.0 * math.pi * round((-0.5 * math.pi * shape.integrators - phase[0]) / (2.0 * math.pi))
    at = int(np.argmax(phase < math.radians(-158.0)))
    gain = 1.0 / (5.0 / 2.0 * abs(response[at]))
    period_s = float(2.0 * math.pi / omega[at])
    step_s = period_s / SAMPLES / STEPS
    scaled = TransferFunction(
        num=tuple(gain * v for v in shape.num), den=shape.den, delay_s=step_s * round(delay / step_s)
    )
    return Case(name=name, plant=scaled, time_s=period_s, sample_time_s=period_s / SAMPLES)


def _lags(*lags: float) -> list[float]:
    den = np.array([1.0])
    for lag in lags:
        den = np.polymul(den, [lag, 1.0])
    return [float(v) for v in den]


def _cases() -> tuple[Case, ...]:
    found: list[Case] = []
    for L in (0.1, 0.3, 1.0, 3.0):
        found.append(_case(f"lag, dead time {L:g}", [1.0], _lags(1.0), L, 1.0 + L))
    for second in (0.1, 0.3, 1.0):
        for L in (0.05, 0.2, 0.6):
            found.append(_case(f"lags 1 and {second:g}, dead time {L:g}", [1.0], _lags(1.0, second), L, 1 + second + L))
    for lag, L in ((0.3, 0.05), (1.0, 0.05), (1.0, 0.3), (1.0, 1.0), (0.0, 1.0), (0.2, 1.0)):
        den = [*_lags(*([lag] if lag else [])), 0.0]
        found.append(_case(f"integrator, lag {lag:g}, dead time {L:g}", [1.0], den, L, lag + L))
    for lags in ((1.0, 0.2, 0.05), (0.5, 0.3)):
        found.append(_case(f"servo, lags {lags}", [1.0], [*_lags(*lags), 0.0], 0.02, sum(lags)))
    for lags in ((1.0, 1.0, 1.0), (1.0, 0.5, 0.2), (1.0, 0.8, 0.1)):
        found.append(_case(f"tanks {lags}", [1.0], _lags(*lags), 0.0, sum(lags)))
        found.append(_case(f"tanks {lags}, dead time", [1.0], _lags(*lags), 0.4, sum(lags) + 0.4))
    for zero in (0.1, 0.3, 0.6):
        found.append(_case(f"inverse response {zero:g}", [-zero, 1.0], _lags(1.0, 0.6), 0.0, 1.6 + zero))
    found.append(_case("inverse response, dead time", [-0.3, 1.0], _lags(1.0, 0.5), 0.3, 2.1))
    for damping in (0.03, 0.1, 0.3):  # resonance at about three times the crossover of the rest
        for w in (5.0, 8.0):
            den = np.polymul(_lags(1.0, 0.3), [1.0 / w**2, 2.0 * damping / w, 1.0])
            found.append(_case(f"resonance at {w:g}, damping {damping:g}", [1.0], list(den), 0.1, 1.4))
    for lags in ((1.0,) * 5, (1.0, 0.5, 0.25, 0.125, 0.0625), (1.0, 0.6, 0.3, 0.3, 0.1)):
        found.append(_case(f"fifth order {lags}", [1.0], _lags(*lags), 0.0, sum(lags)))
    found.append(_case("oscillating", [1.0], [1.0, 0.6, 1.0], 0.0, 1.0))
    found.append(
        _case("oscillating, lag and dead time", [1.0], list(np.polymul([4.0, 1.2, 1.0], [1.0, 1.0])), 1.0, 4.0)
    )
    found.append(_case("lead", [0.3, 1.0], _lags(1.0, 1.0, 0.1), 0.2, 2.3))
    return tuple(found)


CASES = _cases()
