"""Whether the recorded command follows the controller that is said to have made it.

The law D(q) u = N(q) e is checked as an equation on the recorded samples, so that neither the controller's state at
the first row nor an integrator's drift enters: what is left over, relative to what the law contributes, is the verdict.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.signal import cont2discrete, lfilter

from autotune.arrays import FloatArray, smallest_step
from autotune.controller import Controller, DiscreteController, PIDController
from autotune.errors import InputError
from autotune.models import TransferFunction

#: Share of the command's motion that the law leaves unexplained, above which the file contradicts the data.
CONTRADICTION = 0.1

Method: TypeAlias = Literal["backward_diff", "bilinear", "euler", "zoh"]
_METHODS: tuple[Method, ...] = ("backward_diff", "bilinear", "euler", "zoh")
Summation: TypeAlias = Literal["set-point", "command"]


@dataclass(frozen=True, kw_only=True)
class LawCheck:
    """How a controller file and a recording agree.

    Attributes
    ----------
    controller : DiscreteController
        The discrete law that fits best among the usual ways to compute the file's law with the sample time.
    summation : {"set-point", "command"}
        Where r enters: u = C (r - y), or u = r - C y.
    unexplained : float
        Root mean square of the command's motion that the law does not explain, relative to that motion.
    gain_ratio : float
        Gain with which the law would explain the most, 1 where the file is right.
    rounding : float
        The part of ``unexplained`` that rounding the command to its resolution in the recording can have made; none of
        what another gain would explain.
    """

    controller: DiscreteController
    summation: Summation
    unexplained: float
    gain_ratio: float
    rounding: float

    @property
    def beyond_rounding(self) -> float:
        """Unexplained share of the command's motion that its rounding does not account for."""
        return math.sqrt(self.unexplained**2 - self.rounding**2)

    @property
    def contradicts(self) -> bool:
        """Whether the recorded command cannot have come from this law."""
        return not self.beyond_rounding <= CONTRADICTION


def check_law(
    controller: Controller,
    u: FloatArray,
    y: FloatArray,
    r: FloatArray | None,
    sample_time_s: float,
    *,
    added: FloatArray | None = None,
) -> LawCheck:
    """Compare the recorded command with the stated control law.

    Parameters
    ----------
    controller : Controller
        As the file says; a continuous law is tried with the usual discretisations.
    u, y : (N,) arrays
        Command and measurement.
    r : (N,) array or None
        Recorded set-point or signal added to the command; where it is None it is taken as constant.
    sample_time_s : float
        Sample time of the recording [s].
    added : (N,) array, optional
        Dither that was added to the controller's output.

    Returns
    -------
    LawCheck
        For the summation and discretisation that explain the most.

    Raises
    ------
    InputError
        A discrete controller with another sample time than the recording's.

    Notes
    -----
    Rows in which the command sits at its extremes (saturated) are left out. A converter, or a log with few digits,
    rounds the command after the law: errors uniform over the smallest difference between recorded values are allowed.
    """
    own = u - (np.zeros_like(u) if added is None else added)
    reference = np.zeros_like(u) if r is None else r
    rows, step = _rows_within_extremes(u), smallest_step(u)
    checks = []
    for law in _discrete_laws(controller, sample_time_s):
        for late in (0, 1):  # computed from this row's measurement, or from the one before
            num = (0.0,) * late + law.num
            named = DiscreteController(num=num, den=law.den, sample_time_s=sample_time_s)
            checks.append(_check(named, "set-point", own, reference - y, rows, step))
            if r is not None:
                checks.append(_check(named, "command", own - reference, -y, rows, step))
    return min(checks, key=lambda check: check.unexplained)


def _discrete_laws(controller: Controller, sample_time_s: float) -> tuple[DiscreteController, ...]:
    """Return the discrete laws that a controller file can mean at a sample time.

    Raises
    ------
    InputError
        A discrete controller with another sample time.
    """
    match controller:
        case DiscreteController():
            if abs(controller.sample_time_s / sample_time_s - 1.0) > 0.01:
                raise InputError(
                    f"the controller's sample time is {controller.sample_time_s:g} s, the recording's "
                    f"{sample_time_s:g} s",
                    where="controller",
                    remedy="give the controller at the recording's sample time",
                )
            return (controller,)
        case PIDController():
            continuous = controller.transfer_function()
        case TransferFunction():
            continuous = controller
    if continuous.delay_s or not continuous.is_proper:
        raise InputError(
            "a controller with dead time or more zeros than poles has no single discrete law",
            where="controller",
            remedy="give num, den and sample_time_s of the law as it runs",
        )
    laws = []
    for method in _METHODS:
        num, den = _discretise(continuous, sample_time_s, method)
        law = DiscreteController(num=tuple(num / den[0]), den=tuple(den / den[0]), sample_time_s=sample_time_s)
        laws.append(law)
    return tuple(laws)


def _discretise(law: TransferFunction, sample_time_s: float, method: Method) -> tuple[FloatArray, FloatArray]:
    num, den = np.array(law.num, dtype=np.float64), np.array(law.den, dtype=np.float64)
    result = cont2discrete((num, den), sample_time_s, method=method)
    return np.asarray(np.real(result[0]), dtype=np.float64).ravel(), np.asarray(np.real(result[1]), dtype=np.float64)


def _check(
    law: DiscreteController, summation: Summation, own: FloatArray, error: FloatArray, rows: FloatArray, step: float
) -> LawCheck:
    skip = max(len(law.num), len(law.den)) - 1
    moved = lfilter(law.den, [1.0], own)[skip:]
    said = lfilter(law.num, [1.0], error)[skip:]
    kept = np.convolve(rows, np.ones(skip + 1), mode="valid") >= skip + 1
    if kept.sum() < 10:
        return LawCheck(controller=law, summation=summation, unexplained=math.inf, gain_ratio=math.nan, rounding=0.0)
    moved, said = moved[kept] - moved[kept].mean(), said[kept] - said[kept].mean()
    motion = float(np.sqrt(np.mean(moved**2)))
    rest = float(np.sqrt(np.mean((moved - said) ** 2)))
    power = float(said @ said)
    gain = float(moved @ said) / power if power > 0 else math.nan
    by_no_gain = float(np.sqrt(np.mean((moved - gain * said) ** 2))) if power > 0 else rest
    rounded = step / math.sqrt(12.0) * float(np.linalg.norm(law.den))
    return LawCheck(
        controller=law,
        summation=summation,
        unexplained=rest / motion if motion > 0 else math.inf,
        gain_ratio=gain,
        rounding=min(rounded, by_no_gain, rest) / motion if motion > 0 else 0.0,
    )


def _rows_within_extremes(u: FloatArray) -> FloatArray:
    """Return 1.0 for rows inside the extremes of u, or for all rows where the extremes are not dwelt on."""
    keep = np.ones(len(u))
    for extreme in (u.min(), u.max()):
        at = u == extreme
        if 0.01 * len(u) < at.sum() < 0.9 * len(u):
            keep[at] = 0.0
    return keep
