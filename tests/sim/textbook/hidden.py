"""Effects that a plant of a textbook can conceal, written for its integration here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, pi, sin, tanh

import numpy as np

from tests.sim.textbook.plant import Floats, Place

#: Watt per square metre and K^4 times surface and emissivity over heat capacity: the Temperature Control Lab's.
RADIATION = 0.9 * 5.67e-8 * 1.2e-3 / 2.0


@dataclass(frozen=True, kw_only=True)
class Scale:
    """How a clean recording moves; sizes of effects are shares of these.

    Attributes
    ----------
    dt_s, duration_s : float
        Sample time and length.
    u, y : (rows,) arrays
        Command and reading.
    speed, position : float
        Standard deviations at the place.
    top : float
        Largest position over its median, and that median.
    middle : float
        Median position.
    force : float
        Standard deviation of the acceleration at the place times its inertia.
    noise : float
        Of the reading.
    """

    dt_s: float
    duration_s: float
    u: Floats
    y: Floats
    speed: float
    position: float
    top: float
    middle: float
    force: float
    noise: float


@dataclass(frozen=True, kw_only=True)
class Hidden:
    """One concealed effect, by where it meets the way from command to reading.

    Attributes
    ----------
    name, where : str
        As a diagnosis should say them; ``where`` is a state, port or input, nothing for the sensor.
    held : callable
        The command that is held after a new one, from that and the one before.
    command : callable of time, value and the actuator's own state
        What arrives at the plant.
    actuator : callable of the value and the own state
        The own state's derivative, where there is one.
    delay_s : float
        Dead time of the command.
    force : callable of time, speed and position
        What acts at the place.
    reading : callable of time and reading
        Before the noise.
    converted : callable
        A reading as it is recorded.
    spoiled : callable
        All readings as they are recorded.
    """

    name: str = ""
    where: str = ""
    held: Callable[[float, float], float] = lambda u, before: u
    command: Callable[[float, float, float], float] = lambda t, u, own: u
    actuator: Callable[[float, float], float] | None = None
    delay_s: float = 0.0
    force: Callable[[float, float, float], float] | None = None
    reading: Callable[[float, float], float] = lambda t, y: y
    converted: Callable[[float], float] = lambda y: y
    spoiled: Callable[[Floats], Floats] = lambda y: y


def hidden(name: str, where: str, size: float, place: Place | None, s: Scale, rng: np.random.Generator) -> Hidden:
    """Return an effect of a size, times 0.8 to 1.25 by chance.

    Raises
    ------
    KeyError
        A name that is not written here.
    """
    a = size * float(rng.uniform(0.8, 1.25))
    group = name.split(".")[0]
    make = {"plant": _force, "environment": _load, "sensor": _sensor}.get(group, _command)
    found = make(name, a, s, rng)
    inertia = 1.0 if place is None else place.inertia
    if found.force is not None and name in ("plant.radiation_loss", "plant.hard_stop"):
        law = found.force
        found = Hidden(force=lambda t, v, x: inertia * law(t, v, x))
    return Hidden(**{**found.__dict__, "name": name, "where": where})


def _sign(v: float, s: Scale) -> float:
    """Dry friction's sign: within a ten-thousandth of the usual speed it sticks."""
    return tanh(v / (1e-4 * s.speed))


def _force(name: str, a: float, s: Scale, rng: np.random.Generator) -> Hidden:
    F, V, X = s.force, s.speed, max(s.position, 1e-12)
    # a stop that is never met conceals nothing
    high, stiffness = s.middle + min(a, 0.85) * s.top, (0.4 / s.dt_s) ** 2
    laws: dict[str, Callable[[float, float, float], float]] = {
        "plant.coulomb_friction": lambda t, v, x: -a * F * _sign(v, s),
        "plant.stribeck_friction": lambda t, v, x: -a * F * (0.5 + exp(-((v / (0.15 * V)) ** 2))) * _sign(v, s),
        "plant.quadratic_drag": lambda t, v, x: -a * F / V**2 * v * abs(v),
        "plant.nonlinear_loss": lambda t, v, x: -a * F / V**2 * v * abs(v),
        "plant.leak": lambda t, v, x: -a * F / V * v,
        "plant.cubic_stiffness": lambda t, v, x: -a * F / X**3 * x**3,
        "plant.radiation_loss": lambda t, v, x: -a * RADIATION * ((v + 273.15) ** 4 - 293.15**4),
        "plant.hard_stop": lambda t, v, x: (
            -stiffness * (x - high) - 0.8 * stiffness**0.5 * max(v, 0.0) if x > high else 0.0
        ),
    }
    return Hidden(force=laws[name])


def _load(name: str, a: float, s: Scale, rng: np.random.Generator) -> Hidden:
    begin = float(rng.uniform(0.3, 0.6)) * s.duration_s
    sign = float(rng.choice([-1.0, 1.0]))
    omega, phase = 2.0 * pi * float(rng.uniform(7.0, 16.0)) / s.duration_s, float(rng.uniform(0.0, 6.28))
    laws: dict[str, Callable[[float, float, float], float]] = {
        "environment.step_load": lambda t, v, x: sign * a * s.force if t >= begin else 0.0,
        "environment.periodic_load": lambda t, v, x: 1.4 * a * s.force * sin(omega * t + phase),
    }
    return Hidden(force=laws[name])


def _command(name: str, a: float, s: Scale, rng: np.random.Generator) -> Hidden:
    spread, middle = float(np.std(s.u)), float(np.median(s.u))
    high = middle + a * (float(np.quantile(s.u, 0.995)) - middle)
    half, rate = a * spread, 1.2 * spread / (a * s.dt_s)
    made = {
        "actuator.saturation": lambda: Hidden(command=lambda t, u, own: min(u, high)),
        "actuator.dead_zone": lambda: Hidden(command=lambda t, u, own: u - min(max(u, -half), half)),
        "actuator.nonlinear_gain": lambda: Hidden(command=lambda t, u, own: u + a / spread * (u - middle) ** 2),
        "actuator.gain_drift": lambda: Hidden(command=lambda t, u, own: u * (1.0 + a * t / s.duration_s)),
        "actuator.backlash": lambda: Hidden(held=lambda u, before: min(max(before, u - half), u + half)),
        "actuator.stiction": lambda: Hidden(held=lambda u, before: u if abs(u - before) > half else before),
        "actuator.lag": lambda: Hidden(actuator=lambda u, own: (u - own) / (a * s.dt_s), command=lambda t, u, own: own),
        "actuator.rate_limit": lambda: Hidden(
            actuator=lambda u, own: rate * tanh((u - own) / (1e-3 * spread)), command=lambda t, u, own: own
        ),
        "timing.dead_time": lambda: Hidden(delay_s=a * s.dt_s),
    }
    return made[name]()


def _sensor(name: str, a: float, s: Scale, rng: np.random.Generator) -> Hidden:
    spread, middle = float(np.std(s.y)), float(np.mean(s.y))
    step = a * s.noise

    def outliers(y: Floats) -> Floats:
        struck = rng.random(y.size) < 0.015
        return np.where(struck, y + a * s.noise * rng.choice([-1.0, 1.0], y.size) * rng.uniform(1.0, 3.0, y.size), y)

    def dropouts(y: Floats) -> Floats:
        found = y.copy()
        for begin in rng.choice(y.size - 60, 6, replace=False) + 20:
            found[begin : begin + int(a)] = found[begin]
        return found

    made = {
        "sensor.nonlinear_gain": lambda: Hidden(reading=lambda t, y: y + a / spread * (y - middle) ** 2),
        "sensor.drift": lambda: Hidden(reading=lambda t, y: y + a * spread * t / s.duration_s),
        "sensor.quantisation": lambda: Hidden(converted=lambda y: step * round(y / step)),
        "sensor.outliers": lambda: Hidden(spoiled=outliers),
        "sensor.dropout": lambda: Hidden(spoiled=dropouts),
    }
    return made[name]()
