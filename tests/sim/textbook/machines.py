"""Textbook plants with forces and torques."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin

import numpy as np

from tests.sim.textbook.plant import Floats, Numbers, Place, Plant, steps, wave

PENDULUM_MODEL = """
name = "pendulum"
[[input]]
column = "u"
unit = "N m"
[output]
value = "theta"
unit = "rad"
[[state]]
name = "theta"
unit = "rad"
kind = "position"
derivative = "omega"
[[state]]
name = "omega"
unit = "rad/s"
kind = "speed"
of = "theta"
derivative = "(u - k*l^2*omega - m*g*l*sin(theta))/(m*l^2)"
[parameters]
m = { value = 0.5, unit = "kg" }
l = { value = 0.4, unit = "m", fixed = true }
k = { value = 0.5, unit = "kg/s", spread = 0.5 }
g = { value = 9.81, unit = "m/s^2", fixed = true }
"""


def _pendulum(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    inertia = p["m"] * p["l"] ** 2
    torque = w[0] - p["k"] * p["l"] ** 2 * x[1] - p["m"] * p["g"] * p["l"] * sin(x[0])
    return [x[1], torque / inertia + f[0]]


def _pendulum_parametric(
    t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers
) -> list[float]:
    """Return the slopes on a pivot that shakes: gravity swings."""
    shaken = dict(p) | {"g": p["g"] * (1.0 + 0.25 * sin(3.1 * t))}
    return _pendulum(t, x, w, f, shaken)


PENDULUM = Plant(
    name="pendulum",
    source="H. K. Khalil, Nonlinear Systems, 3rd edition, section 1.2.1, equation (1.5) with a torque",
    model=PENDULUM_MODEL,
    slopes=_pendulum,
    reading=lambda x, w: x[0],
    places=(Place(key="state", name="omega", speed=lambda x: x[1], position=lambda x: x[0]),),
    dt_s=0.02,
    start=(0.0, 0.0),
    noise=0.004,
    columns=lambda rng, rows: {"u": steps(rng, rows, 15, 60, -0.65, 0.65)},
    effects=(
        ("plant.coulomb_friction", "omega", 0.08), ("plant.quadratic_drag", "omega", 0.15),
        ("plant.cubic_stiffness", "omega", 0.15), ("plant.hard_stop", "omega", 0.85),
        ("actuator.saturation", "u", 0.7), ("actuator.dead_zone", "u", 0.2), ("timing.dead_time", "u", 2.5),
        ("environment.step_load", "omega", 0.15), ("environment.periodic_load", "omega", 0.15),
        ("sensor.nonlinear_gain", "", 0.1),
    ),
    outside=_pendulum_parametric,
)  # fmt: skip

CART_MODEL = """
name = "cart and hanging pole"
[[input]]
column = "u"
unit = "N"
[output]
value = "p"
unit = "m"
[define]
D = "M + m*sin(a)^2"
F = "u - c*v + F_d"
T = "T_d - b*w"
[[port]]
name = "F_d"
kind = "force"
across = "v"
unit = "N"
[[port]]
name = "T_d"
kind = "torque"
across = "w"
unit = "N m"
[[state]]
name = "p"
unit = "m"
kind = "position"
derivative = "v"
[[state]]
name = "v"
unit = "m/s"
kind = "speed"
of = "p"
derivative = "(F + m*sin(a)*(l*w^2 + g*cos(a)) - T*cos(a)/l)/D"
[[state]]
name = "a"
unit = "rad"
kind = "position"
derivative = "w"
[[state]]
name = "w"
unit = "rad/s"
kind = "speed"
of = "a"
derivative = "(-cos(a)*F - m*l*w^2*sin(a)*cos(a) - (M + m)*g*sin(a) + (M + m)*T/(m*l))/(l*D)"
[parameters]
M = { value = 0.5, unit = "kg" }
m = { value = 0.2, unit = "kg" }
c = { value = 0.6, unit = "N s/m", spread = 0.5 }
b = { value = 0.003, unit = "N m s/rad", spread = 0.5 }
l = { value = 0.3, unit = "m", fixed = true }
g = { value = 9.81, unit = "m/s^2", fixed = true }
"""


def _cart(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    """Solve the two equations of motion for the accelerations by Cramer's rule; the angle is from hanging."""
    M, m, length, g = p["M"], p["m"], p["l"], p["g"]
    _, v, a, r = x
    force = w[0] - p["c"] * v + f[0] + m * length * r**2 * sin(a)
    torque = f[1] - p["b"] * r - m * g * length * sin(a)
    a11, a12, a22 = M + m, m * length * cos(a), m * length**2
    det = a11 * a22 - a12**2
    return [v, (force * a22 - a12 * torque) / det, r, (a11 * torque - a12 * force) / det]


def _cart_on_rust(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    """Return the slopes on a rail whose drag changes with the place and the time."""
    return _cart(t, x, w, (f[0] - 1.2 * x[1] * (1.0 + sin(5.0 * x[0] + 1.3 * t)), f[1]), p)


CART = Plant(
    name="cart-pole",
    source="K. J. Astrom and R. M. Murray, Feedback Systems, 2nd edition, example 3.2 (balance system), about hanging; "
    "numbers of the University of Michigan's Control Tutorials, Inverted Pendulum",
    model=CART_MODEL,
    slopes=_cart,
    reading=lambda x, w: x[0],
    places=(
        Place(key="port", name="F_d", speed=lambda x: x[1], position=lambda x: x[0], inertia=0.7),
        Place(key="port", name="T_d", speed=lambda x: x[3], position=lambda x: x[2], inertia=0.018),
    ),
    dt_s=0.02,
    start=(0.0, 0.0, 0.0, 0.0),
    noise=0.001,
    columns=lambda rng, rows: {"u": _zero_mean(rng, rows, 2.5)},
    effects=(
        ("plant.coulomb_friction", "F_d", 0.12), ("plant.stribeck_friction", "F_d", 0.12),
        ("plant.quadratic_drag", "F_d", 0.2), ("plant.coulomb_friction", "T_d", 0.12),
        ("actuator.backlash", "u", 0.3), ("actuator.saturation", "u", 0.7), ("actuator.dead_zone", "u", 0.2),
        ("timing.dead_time", "u", 2.5), ("actuator.rate_limit", "u", 6.0), ("environment.step_load", "F_d", 0.15),
    ),
    outside=_cart_on_rust,
)  # fmt: skip


def _zero_mean(rng: np.random.Generator, rows: int, size: float) -> Floats:
    """Return steps there and back, so that a cart stays on its rail."""
    found: list[float] = []
    while len(found) < rows:
        level, count = float(rng.uniform(-size, size)), int(rng.integers(10, 35))
        found += [level] * count + [-level] * count
    return np.array(found[:rows])


MOTOR_MODEL = """
name = "dc motor"
[[input]]
column = "u"
[[input]]
column = "supply"
unit = "V"
hold = "linear"
[output]
value = "w"
unit = "rad/s"
[[port]]
name = "T_d"
kind = "torque"
across = "w"
unit = "N m"
[[state]]
name = "i"
unit = "A"
kind = "current"
derivative = "(u*supply - R*i - k*w)/L"
[[state]]
name = "w"
unit = "rad/s"
kind = "speed"
derivative = "(k*i - b*w + T_d)/J"
[parameters]
J = { value = 0.01, unit = "kg m^2" }
b = { value = 0.1, unit = "N m s/rad" }
k = { value = 0.5, unit = "N m/A" }
R = { value = 1.0, unit = "ohm" }
L = { value = 0.05, unit = "H", fixed = true }
"""


def _motor(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    i, speed = x
    return [(w[0] * w[1] - p["R"] * i - p["k"] * speed) / p["L"], (p["k"] * i - p["b"] * speed + f[0]) / p["J"]]


def _motor_of_two_speeds(
    t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers
) -> list[float]:
    """Return the slopes with a brush that loses contact now and then."""
    return _motor(t, x, w, f, dict(p) | {"R": p["R"] * (1.6 if sin(4.3 * t) > 0.2 else 1.0)})


MOTOR = Plant(
    name="dc motor",
    source="University of Michigan, Control Tutorials for MATLAB and Simulink, Motor Speed: System Modeling; a larger "
    "torque constant, a bridge with a measured supply",
    model=MOTOR_MODEL,
    slopes=_motor,
    reading=lambda x, w: x[1],
    places=(Place(key="port", name="T_d", speed=lambda x: x[1], inertia=0.01),),
    dt_s=0.01,
    start=(0.0, 0.0),
    noise=0.05,
    columns=lambda rng, rows: {"u": steps(rng, rows, 15, 50, -1.0, 1.0), "supply": wave(rng, rows, 400.0, 12.0, 1.0)},
    effects=(
        ("plant.coulomb_friction", "T_d", 0.15), ("plant.stribeck_friction", "T_d", 0.15),
        ("plant.quadratic_drag", "T_d", 0.2), ("environment.step_load", "T_d", 0.15),
        ("actuator.saturation", "u", 0.7), ("actuator.dead_zone", "u", 0.2), ("timing.dead_time", "u", 2.5),
        ("actuator.nonlinear_gain", "u", 0.1), ("sensor.drift", "", 0.2), ("sensor.outliers", "", 10.0),
    ),
    outside=_motor_of_two_speeds,
)  # fmt: skip

CAR_MODEL = """
name = "quarter car"
[[input]]
column = "u"
unit = "N"
[[input]]
column = "road"
unit = "m"
hold = "linear"
[output]
value = "zb - zw"
unit = "m"
[[port]]
name = "F_d"
kind = "force"
across = "vb - vw"
unit = "N"
[[state]]
name = "zb"
unit = "m"
kind = "position"
derivative = "vb"
[[state]]
name = "vb"
unit = "m/s"
kind = "speed"
of = "zb"
derivative = "(-ks*(zb - zw) - bs*(vb - vw) + u + F_d)/mb"
[[state]]
name = "zw"
unit = "m"
kind = "position"
derivative = "vw"
[[state]]
name = "vw"
unit = "m/s"
kind = "speed"
of = "zw"
derivative = "(ks*(zb - zw) + bs*(vb - vw) - u - F_d - kt*(zw - road) - bt*vw)/mw"
[parameters]
mb = { value = 2.45, unit = "kg", fixed = true }
mw = { value = 1.0, unit = "kg" }
ks = { value = 900.0, unit = "N/m" }
bs = { value = 7.5, unit = "N s/m", spread = 0.5 }
kt = { value = 2500.0, unit = "N/m" }
bt = { value = 5.0, unit = "N s/m", spread = 0.5 }
"""


def _car(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    zb, vb, zw, vw = x
    strut = -p["ks"] * (zb - zw) - p["bs"] * (vb - vw) + w[0] + f[0]
    tyre = -p["kt"] * (zw - w[1]) - p["bt"] * vw
    return [vb, strut / p["mb"], vw, (tyre - strut) / p["mw"]]


def _car_fading(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    """Return the slopes with a damper whose valve opens and closes by itself."""
    return _car(t, x, w, f, dict(p) | {"bs": p["bs"] * (4.0 if sin(2.7 * t) > 0.3 else 1.0)})


CAR = Plant(
    name="quarter car",
    source="R. Rajamani, Vehicle Dynamics and Control, 2nd edition, section 10.2; numbers of Quanser's "
    "Active Suspension laboratory manual",
    model=CAR_MODEL,
    slopes=_car,
    reading=lambda x, w: x[0] - x[2],
    places=(Place(key="port", name="F_d", speed=lambda x: x[1] - x[3], position=lambda x: x[0] - x[2], inertia=0.7),),
    dt_s=0.01,
    start=(0.0, 0.0, 0.0, 0.0),
    noise=0.0001,
    columns=lambda rng, rows: {"u": steps(rng, rows, 15, 50, -8.0, 8.0), "road": wave(rng, rows, 300.0, 0.0, 0.01)},
    effects=(
        ("plant.coulomb_friction", "F_d", 0.08), ("plant.quadratic_drag", "F_d", 0.15),
        ("plant.cubic_stiffness", "F_d", 0.2), ("plant.hard_stop", "F_d", 0.8),
        ("actuator.saturation", "u", 0.7), ("actuator.dead_zone", "u", 0.2), ("timing.dead_time", "u", 1.5),
        ("actuator.backlash", "u", 0.3), ("actuator.nonlinear_gain", "u", 0.1), ("environment.step_load", "F_d", 0.3),
    ),
    outside=_car_fading,
)  # fmt: skip

MAGLEV_MODEL = """
name = "magnetic levitation"
horizon_s = 0.06
[[input]]
column = "u"
unit = "A"
[output]
value = "z"
unit = "mm"
[[state]]
name = "z"
unit = "mm"
kind = "position"
derivative = "v"
[[state]]
name = "v"
unit = "mm/s"
kind = "speed"
of = "z"
derivative = "g - C*u^2/(z + z0)^2 - k*v"
[parameters]
C = { value = 980000.0, unit = "mm^3/(s^2 A^2)" }
z0 = { value = 2.0, unit = "mm" }
k = { value = 0.5, unit = "1/s", spread = 0.5 }
g = { value = 9810.0, unit = "mm/s^2", fixed = true }
"""


def _maglev(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    gap = max(x[0] + p["z0"], 0.1)
    return [x[1], p["g"] - p["C"] * w[0] ** 2 / gap**2 - p["k"] * x[1] + f[0]]


def _maglev_swinging(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    """Return the slopes with a ball that turns: its magnetic moment comes and goes."""
    return _maglev(t, x, w, f, dict(p) | {"C": p["C"] * (1.0 + 0.15 * sin(23.0 * t + 2.0 * sin(3.7 * t)))})


def _lead(k: int, y: float, memory: dict[str, float]) -> float:
    """Hold the gap by proportional and filtered derivative action; the gap grows without current."""
    before = memory.get("y", y)
    rate = 0.5 * memory.get("rate", 0.0) + 0.5 * (y - before) / 0.002
    memory |= {"y": y, "rate": rate}
    return float(np.clip(0.25 * (y - 8.0) + 0.006 * rate, -0.8, 1.5))


MAGLEV = Plant(
    name="maglev",
    source="H. K. Khalil, Nonlinear Systems, 3rd edition, exercise 1.18, force C (i/(z + z0))^2",
    model=MAGLEV_MODEL,
    slopes=_maglev,
    reading=lambda x, w: x[0],
    places=(Place(key="state", name="v", speed=lambda x: x[1], position=lambda x: x[0]),),
    dt_s=0.002,
    start=(8.0, 0.0),
    noise=0.005,
    columns=lambda rng, rows: {"u": 1.0 + steps(rng, rows, 10, 40, -0.15, 0.15)},
    law=_lead,
    within=(1.0, 20.0),
    effects=(
        ("actuator.lag", "u", 1.5), ("timing.dead_time", "u", 1.0), ("actuator.saturation", "u", 0.8),
        ("actuator.nonlinear_gain", "u", 0.15), ("environment.step_load", "v", 0.4),
        ("environment.periodic_load", "v", 0.4), ("sensor.drift", "", 0.4),
        ("sensor.quantisation", "", 4.0), ("actuator.backlash", "u", 0.3), ("sensor.outliers", "", 10.0),
    ),
    outside=_maglev_swinging,
)  # fmt: skip

ARM_MODEL = """
name = "fan and arm"
[[input]]
column = "u"
unit = "V"
[output]
value = "theta"
unit = "rad"
[[state]]
name = "n"
unit = "rad/s"
kind = "other"
derivative = "(kf*u - n)/T"
[[state]]
name = "theta"
unit = "rad"
kind = "position"
derivative = "omega"
[[state]]
name = "omega"
unit = "rad/s"
kind = "speed"
of = "theta"
derivative = "(kt*n^2*d - c*omega - m*g*r*sin(theta))/J"
[parameters]
kf = { value = 60.0, unit = "rad/(s V)", fixed = true }
T = { value = 0.15, unit = "s" }
kt = { value = 6.5e-6, unit = "N s^2/rad^2" }
d = { value = 0.22, unit = "m", fixed = true }
c = { value = 0.004, unit = "N m s/rad", spread = 0.5 }
m = { value = 0.1, unit = "kg", fixed = true }
r = { value = 0.12, unit = "m" }
J = { value = 0.003, unit = "kg m^2" }
g = { value = 9.81, unit = "m/s^2", fixed = true }
"""


def _arm(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    n, theta, omega = x
    torque = p["kt"] * n**2 * p["d"] - p["c"] * omega - p["m"] * p["g"] * p["r"] * sin(theta)
    return [(p["kf"] * w[0] - n) / p["T"], omega, torque / p["J"] + f[0]]


def _arm_in_gusts(t: float, x: Sequence[float], w: Sequence[float], f: Sequence[float], p: Numbers) -> list[float]:
    """Return the slopes with a fan whose stream tears off and comes back."""
    return _arm(t, x, w, f, dict(p) | {"kt": p["kt"] * (0.7 if sin(1.9 * t + sin(0.7 * t)) > 0.4 else 1.0)})


ARM = Plant(
    name="fan and arm",
    source="E. T. Enikov and G. Campa, Mechatronic Aeropendulum, IEEE Transactions on Education 55 (2012) 538-545",
    model=ARM_MODEL,
    slopes=_arm,
    reading=lambda x, w: x[1],
    places=(Place(key="state", name="omega", speed=lambda x: x[2], position=lambda x: x[1]),),
    dt_s=0.02,
    start=(150.0, 0.2, 0.0),
    noise=0.002,
    columns=lambda rng, rows: {"u": steps(rng, rows, 20, 80, 1.0, 4.2)},
    effects=(
        ("plant.coulomb_friction", "omega", 0.1), ("plant.quadratic_drag", "omega", 0.2),
        ("plant.hard_stop", "omega", 0.8), ("actuator.saturation", "u", 0.75), ("timing.dead_time", "u", 3.5),
        ("actuator.rate_limit", "u", 20.0), ("actuator.gain_drift", "u", 0.15), ("actuator.backlash", "u", 0.3),
        ("environment.step_load", "omega", 0.2), ("sensor.nonlinear_gain", "", 0.1),
    ),
    outside=_arm_in_gusts,
)  # fmt: skip

MACHINES = (PENDULUM, CART, MOTOR, CAR, MAGLEV, ARM)
