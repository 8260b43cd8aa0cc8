"""Textbook plants with levels, temperatures and flows."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, sin, sqrt

from tests.sim.textbook.plant import Numbers, Place, Plant, steps, wave

HEATER_MODEL = """
name = "heater"
[[input]]
column = "u"
unit = "%"
[[input]]
column = "ambient"
unit = "degC"
hold = "linear"
[output]
value = "T"
unit = "degC"
[[state]]
name = "T"
unit = "degC"
kind = "temperature"
derivative = "(alpha*u + UA*(ambient - T))/C"
[parameters]
alpha = { value = 0.01, unit = "W/%" }
UA = { value = 0.012, unit = "W/K" }
C = { value = 2.0, unit = "J/K" }
"""


def _heater(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    return [(p["alpha"] * w[0] + p["UA"] * (w[1] - x[0])) / p["C"] + f[0]]


def _heater_in_draught(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    """Return the slopes where a door opens and closes: the loss comes and goes."""
    return _heater(t, x, w, f, dict(p) | {"UA": p["UA"] * (1.7 if sin(0.011 * t + sin(0.004 * t)) > 0.3 else 1.0)})


HEATER = Plant(
    name="heater",
    source="J. D. Hedengren, Temperature Control Lab (TCLab), Lab A energy balance, apmonitor.com; heat capacity and "
    "loss of one heater",
    model=HEATER_MODEL,
    slopes=_heater,
    reading=lambda x, w: x[0],
    places=(Place(key="state", name="T", speed=lambda x: x[0]),),
    dt_s=4.0,
    start=(23.0,),
    noise=0.1,
    columns=lambda rng, rows: {
        "u": steps(rng, rows, 30, 120, 0.0, 100.0), "ambient": wave(rng, rows, 700.0, 23.0, 2.0),
    },
    effects=(
        ("plant.radiation_loss", "T", 1.0), ("plant.nonlinear_loss", "T", 0.1), ("environment.step_load", "T", 0.15),
        ("environment.periodic_load", "T", 0.2), ("actuator.saturation", "u", 0.75), ("timing.dead_time", "u", 4.5),
        ("actuator.gain_drift", "u", 0.15), ("actuator.nonlinear_gain", "u", 0.1), ("sensor.dropout", "", 20.0),
        ("sensor.quantisation", "", 6.0),
    ),
    outside=_heater_in_draught,
)  # fmt: skip

TANKS_MODEL = """
name = "two coupled tanks"
[[input]]
column = "u"
unit = "V"
[output]
value = "h2"
unit = "cm"
[[state]]
name = "h1"
unit = "cm"
kind = "level"
derivative = "(k*u - a1*sqrt(max(2*g*h1, 0)))/A"
[[state]]
name = "h2"
unit = "cm"
kind = "level"
derivative = "(a1*sqrt(max(2*g*h1, 0)) - a2*sqrt(max(2*g*h2, 0)))/A"
[parameters]
k = { value = 4.6, unit = "cm^3/(s V)" }
a1 = { value = 0.178, unit = "cm^2" }
a2 = { value = 0.178, unit = "cm^2" }
A = { value = 15.5, unit = "cm^2", fixed = true }
g = { value = 981.0, unit = "cm/s^2", fixed = true }
"""


def _tanks(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    upper, lower = (sqrt(2.0 * p["g"] * max(level, 0.0)) for level in x)
    through = p["a1"] * upper
    return [(p["k"] * w[0] - through) / p["A"] + f[0], (through - p["a2"] * lower) / p["A"] + f[1]]


def _tanks_clogging(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    """Something that swims before the upper outlet and away again."""
    return _tanks(t, x, w, f, dict(p) | {"a1": p["a1"] * (0.75 if sin(0.05 * t + sin(0.017 * t)) > 0.3 else 1.0)})


TANKS = Plant(
    name="two coupled tanks",
    source="Quanser, Coupled Tanks laboratory manual (configuration 2); the same equations in K. H. Johansson, The "
    "Quadruple-Tank Process, IEEE Transactions on Control Systems Technology 8 (2000) 456-465",
    model=TANKS_MODEL,
    slopes=_tanks,
    reading=lambda x, w: x[1],
    places=(
        Place(key="state", name="h1", speed=lambda x: x[0]),
        Place(key="state", name="h2", speed=lambda x: x[1]),
    ),
    dt_s=0.5,
    start=(10.0, 10.0),
    noise=0.03,
    columns=lambda rng, rows: {"u": steps(rng, rows, 25, 100, 3.0, 8.0)},
    effects=(
        ("plant.leak", "h2", 0.2), ("plant.nonlinear_loss", "h2", 0.05), ("environment.step_load", "h1", 0.2),
        ("environment.periodic_load", "h2", 0.2), ("actuator.saturation", "u", 0.65), ("timing.dead_time", "u", 6.5),
        ("actuator.gain_drift", "u", 0.15), ("actuator.backlash", "u", 0.3), ("sensor.outliers", "", 10.0),
        ("sensor.nonlinear_gain", "", 0.1),
    ),
    outside=_tanks_clogging,
)  # fmt: skip

REACTOR_MODEL = """
name = "stirred reactor"
[[input]]
column = "u"
unit = "K"
[output]
value = "T"
unit = "K"
[define]
r = "k0*exp(-E/T)*c"
[[state]]
name = "c"
unit = "mol/l"
kind = "other"
derivative = "q*(cf - c) - r"
[[state]]
name = "T"
unit = "K"
kind = "temperature"
derivative = "q*(Tf - T) + H*r + K*(u - T)"
[parameters]
q = { value = 0.016667, unit = "1/s", fixed = true }
cf = { value = 1.0, unit = "mol/l", fixed = true }
Tf = { value = 350.0, unit = "K", fixed = true }
k0 = { value = 1.2e9, unit = "1/s", spread = 0.2 }
E = { value = 8750.0, unit = "K", fixed = true }
H = { value = 209.2, unit = "K l/mol", spread = 0.2 }
K = { value = 0.034868, unit = "1/s" }
"""


def _reactor(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    c, T = x
    r = p["k0"] * exp(-p["E"] / max(T, 100.0)) * c
    return [p["q"] * (p["cf"] - c) - r, p["q"] * (p["Tf"] - T) + p["H"] * r + p["K"] * (w[0] - T) + f[0]]


def _reactor_fed_in_puffs(
    t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers
) -> list[float]:
    """Return the slopes where the feed's concentration swings without being measured."""
    return _reactor(t, x, w, f, dict(p) | {"cf": p["cf"] * (1.35 if sin(0.02 * t + sin(0.007 * t)) > 0.2 else 1.0)})


REACTOR = Plant(
    name="stirred reactor",
    source="D. E. Seborg, T. F. Edgar, D. A. Mellichamp and F. J. Doyle, Process Dynamics and Control, 3rd edition, "
    "example 2.5 (jacketed CSTR), at its cold, stable operating point; minutes turned into seconds",
    model=REACTOR_MODEL,
    slopes=_reactor,
    reading=lambda x, w: x[1],
    places=(Place(key="state", name="T", speed=lambda x: x[1]),),
    dt_s=4.0,
    start=(0.9, 310.0),
    noise=0.05,
    columns=lambda rng, rows: {"u": steps(rng, rows, 15, 60, 282.0, 296.0)},
    effects=(
        ("environment.step_load", "T", 0.25), ("environment.periodic_load", "T", 0.25),
        ("actuator.saturation", "u", 0.7), ("timing.dead_time", "u", 2.5),
        ("actuator.rate_limit", "u", 10.0), ("actuator.backlash", "u", 0.3),
        ("actuator.nonlinear_gain", "u", 0.15), ("sensor.drift", "", 0.3), ("sensor.dropout", "", 20.0),
        ("sensor.quantisation", "", 6.0),
    ),
    outside=_reactor_fed_in_puffs,
)  # fmt: skip

VALVE_MODEL = """
name = "valve with flow"
[[input]]
column = "u"
[[input]]
column = "dp"
unit = "bar"
hold = "linear"
[output]
value = "q"
unit = "m^3/h"
[[state]]
name = "s"
kind = "position"
derivative = "(u - s)/Ts"
[[state]]
name = "q"
unit = "m^3/h"
kind = "other"
derivative = "(dp - (q/(Kv*max(s, 0.02)))^2 - R*q^2)/I"
[parameters]
Ts = { value = 1.5, unit = "s" }
Kv = { value = 16.0, unit = "m^3/(h bar^0.5)" }
R = { value = 0.006, unit = "h^2 bar/m^6" }
I = { value = 0.1, unit = "bar s h/m^3" }
"""


def _valve(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    s, q = x
    loss = (q / (p["Kv"] * max(s, 0.02))) ** 2 + p["R"] * q**2
    return [(w[0] - s) / p["Ts"], (w[1] - loss) / p["I"]]


def _valve_with_bubbles(
    t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers
) -> list[float]:
    """Return the slopes where air in the line comes and goes."""
    return _valve(t, x, w, f, dict(p) | {"R": p["R"] * (2.2 if sin(0.31 * t + sin(0.12 * t)) > 0.3 else 1.0)})


VALVE = Plant(
    name="valve with flow",
    source="IEC 60534-2-1, q = Kv sqrt(dp) of an incompressible flow; the line's inertia and the stem's lag as in "
    "C. A. Smith and A. B. Corripio, Principles and Practice of Automatic Process Control, 3rd edition, chapter 5",
    model=VALVE_MODEL,
    slopes=_valve,
    reading=lambda x, w: x[1],
    places=(),
    dt_s=0.2,
    start=(0.5, 7.0),
    noise=0.03,
    columns=lambda rng, rows: {"u": steps(rng, rows, 15, 60, 0.2, 0.9), "dp": wave(rng, rows, 400.0, 1.5, 0.2)},
    effects=(
        ("actuator.stiction", "u", 0.4), ("actuator.backlash", "u", 0.3), ("actuator.saturation", "u", 0.75),
        ("actuator.rate_limit", "u", 8.0), ("timing.dead_time", "u", 3.5), ("actuator.gain_drift", "u", 0.15),
        ("actuator.nonlinear_gain", "u", 0.15), ("sensor.drift", "", 0.3), ("sensor.outliers", "", 10.0),
        ("sensor.quantisation", "", 6.0),
    ),
    outside=_valve_with_bubbles,
)  # fmt: skip

FLOWS = (HEATER, TANKS, REACTOR, VALVE)
