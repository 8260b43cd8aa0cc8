"""Reference tracking: the prefilter F(s) of figure 1, and flat trajectories within the limits of u, its rate and y.

A plant of constant numerator b and denominator a(s) is flat with z = y: u = a(d/dt) y/b. A reference that is smooth
enough therefore comes with the command that follows it exactly, and limits on that command become a limit on how fast
the transition may be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import PIDController
from autotune.errors import DesignError, InputError
from autotune.models import TransferFunction
from autotune.poles import slowest_lag_s

_SAMPLES = 2001
_SHARE = 1e-6


def prefilter(controller: PIDController) -> TransferFunction:
    """Return F(s) with which u = C (F r - y) has the controller's set-point weight b.

    F = (b T_I s + 1)/(T_I s + 1) for PI. With b = 0 it cancels the zero that C brings into the response to r; it leaves
    feedback and margins alone. For PID F is (b T_I s + 1) (1 + T_f s)/(T_I T_d s^2 + T_I s + 1), as the set-point is
    neither filtered nor differentiated.

    Raises
    ------
    DesignError
        No integral action.

    References
    ----------
    Le & Mendes 2010, figure 1.
    """
    c = controller
    if math.isinf(c.Ti_s):
        raise DesignError("a prefilter belongs to a controller with integral action", where="reference")
    num = np.polymul([c.setpoint_weight * c.Ti_s, 1.0], [c.Tf_s, 1.0])
    return TransferFunction(num=tuple(num), den=(c.Ti_s * c.Td_s, c.Ti_s, 1.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """A transition from rest to rest and the command that follows it.

    Attributes
    ----------
    t_s, y, u : (N,) array
        Time [s], reference output and feed-forward command; y is as it leaves the plant, after its dead time.
    duration_s : float
        Of the transition.
    binding : str
        The limit that decided the duration: ``command``, ``rate`` or ``speed``.
    """

    t_s: FloatArray
    y: FloatArray
    u: FloatArray
    duration_s: float
    binding: str


def flat_transition(
    plant: TransferFunction,
    *,
    y_start: float,
    y_end: float,
    u_rest: float,
    u_min: float,
    u_max: float,
    u_rate: float = math.inf,
    y_speed: float = math.inf,
) -> Trajectory:
    """Return the fastest polynomial transition between two rests that respects the limits.

    Parameters
    ----------
    plant : TransferFunction
        b/a(s) exp(-s L), constant numerator; an integrator is allowed.
    y_start, y_end : float
        Outputs at rest [y unit]; the transition is monotone between them, so y never leaves them.
    u_rest : float
        Command that holds ``y_start`` [u unit].
    u_min, u_max : float
        Limits of the command [u unit].
    u_rate : float
        Largest change of the command per second [u unit/s].
    y_speed : float
        Largest speed of the output [y unit/s].

    Returns
    -------
    Trajectory
        2001 samples over the transition.

    Raises
    ------
    InputError
        A limit of change that is not positive.
    DesignError
        Zeros in the plant, or limits that even an infinitely slow transition breaks; names the output that can be
        reached.

    Notes
    -----
    The polynomial has as many vanishing derivatives at both ends as keep u and its rate continuous. It is the fastest
    of its shape, not of all trajectories: a bang-bang one would be faster and rougher.
    """
    if len(plant.num) != 1 or plant.num[0] == 0.0:
        raise DesignError(
            "a plant with zeros is not flat in its output", where="reference", remedy="leave the zeros out"
        )
    for name, limit in (("u_rate", u_rate), ("y_speed", y_speed)):
        if not limit > 0.0:
            raise InputError(f"{name} = {limit:g}", where="reference", remedy="a limit of change is positive")
    order = len(plant.den) - 1
    shape = _smooth_step(2 * order + 3)
    _reachable(plant, y_start, y_end, u_rest, u_min, u_max)

    def excess(duration: float) -> tuple[float, str]:
        """Largest use of a limit, 1 at the limit, and which."""
        _, y, u = _along(plant, shape, duration, y_start, y_end, u_rest)
        step = duration / (_SAMPLES - 1)
        uses = {
            "command": max(float(np.max(u) - u_rest) / (u_max - u_rest), float(u_rest - np.min(u)) / (u_rest - u_min)),
            "rate": float(np.max(np.abs(np.diff(u)))) / (step * u_rate),
            "speed": float(np.max(np.abs(np.diff(y)))) / (step * y_speed),
        }
        name = max(uses, key=lambda key: uses[key])
        return uses[name], name

    slowest = slowest_lag_s(plant.poles) or 1.0
    fast, slow = 1e-3 * slowest, 1e-3 * slowest
    while excess(slow)[0] > 1.0:
        fast, slow = slow, 2.0 * slow
        if slow > 1e9 * slowest:
            raise DesignError(
                "no duration respects the limits", where="reference", remedy="check u_rest and the limits"
            )
    while slow / fast > 1.0 + _SHARE:
        middle = math.sqrt(slow * fast)
        fast, slow = (middle, slow) if excess(middle)[0] > 1.0 else (fast, middle)
    t, y, u = _along(plant, shape, slow, y_start, y_end, u_rest)
    return Trajectory(t_s=t, y=y, u=u, duration_s=slow, binding=excess(slow)[1])


def _smooth_step(degree: int) -> FloatArray:
    """Polynomial of odd degree 2 k + 1 from 0 to 1 with k vanishing derivatives at both ends, descending powers."""
    k = (degree - 1) // 2
    density = np.array([1.0])  # proportional to x^k (1 - x)^k
    for factor in ([1.0, 0.0], [-1.0, 1.0]):
        for _ in range(k):
            density = np.polymul(density, factor)
    integral = np.polyint(density)
    return np.asarray(integral / np.polyval(integral, 1.0))


def _along(
    plant: TransferFunction, shape: FloatArray, duration: float, y_start: float, y_end: float, u_rest: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    x = np.linspace(0.0, 1.0, _SAMPLES)
    u: FloatArray = np.full(_SAMPLES, u_rest)
    derivative = shape
    for power, a in enumerate(plant.den[::-1]):
        u = np.asarray(u + (y_end - y_start) * a / plant.num[0] * np.polyval(derivative, x) / duration**power)
        derivative = np.asarray(np.polyder(derivative))
    return x * duration, np.asarray(y_start + (y_end - y_start) * np.polyval(shape, x)), u


def _reachable(
    plant: TransferFunction, y_start: float, y_end: float, u_rest: float, u_min: float, u_max: float
) -> None:
    if not u_min < u_rest < u_max:
        raise DesignError(f"u_rest = {u_rest:g} is not within the limits of the command", where="reference")
    static = plant.den[-1] / plant.num[0]
    final = u_rest + static * (y_end - y_start)
    if not u_min <= final <= u_max:
        bound = u_max if final > u_max else u_min
        raise DesignError(
            f"holding {y_end:g} takes u = {final:.4g}, outside {u_min:g} .. {u_max:g}",
            where="reference",
            remedy=f"the furthest output that can be held is {y_start + (bound - u_rest) / static:.4g}",
        )
