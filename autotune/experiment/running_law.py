"""What a rig's own controller computes, from its own y and u, beside what it was given.

A law that ran is known by its output: every way in which a device may understand the same numbers (words in another
order, minutes for seconds, percent for engineering units, the parallel form for the ideal one, the other sign, another
scale of the set-point) is run over the measured y, limits included, and compared with the output that was measured.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numba import njit
from scipy.ndimage import uniform_filter1d

from autotune.arrays import FloatArray
from autotune.controller import PIDController

#: departure of a law's output from the measured one, over the larger of both movements, up to which it is that
#: law; noise apart
AGREES = 0.25
#: part of the given law's departure below which another law's has to be before it is named in its place
BETTER = 0.5
#: samples by which a device may show its output late
LATEST = 3
#: share of samples at a limit from which on the gains cannot be estimated
AT_LIMIT = 0.2
#: relative difference of a gain that is named
UNLIKE = 0.15
#: usual wrong scales of a set-point
_SCALES = (10.0, 0.1, 100.0, 0.01, 1000.0, 0.001)
#: usual factors between a gain in engineering units and one in percent
_PERCENT = (100.0, 0.01)
#: an output that swings faster than the loop should is looked at once more with this part of the smoothing
FINER = 4
#: misreadings that are named where they cannot be told apart
MOST_NAMED = 4
#: departure relative to the least one that explains the output as well
ALIKE = 1.3


@dataclass(frozen=True, kw_only=True, eq=False)
class LawRecord:
    """What is known of a controller while it ran.

    Attributes
    ----------
    y, u : (N,) array
        Measurement [y unit], NaN where unusable; its output without the load, as the device showed it [u unit].
    r, load : (N,) array
        Set-point [y unit]; what was added to its output [u unit].
    sample_time_s : float
        Time between two rows [s].
    u_range : (float, float)
        Limits of the output, load included [u unit].
    smoothing : int
        Rows over which outputs are averaged before they are compared.
    """

    y: FloatArray
    u: FloatArray
    r: FloatArray
    load: FloatArray
    sample_time_s: float
    u_range: tuple[float, float]
    smoothing: int = 1


@dataclass(frozen=True, kw_only=True)
class RunningLaw:
    """The controller that ran.

    Attributes
    ----------
    given : PIDController
        What it was given.
    departure : float
        Of the given law's output from the measured one, over the larger of both movements.
    misreading : str
        What explains the measured output much better; empty where nothing does.
    K, Ti_s, Td_s : float
        Estimates [u unit/y unit, s, s]; those of the misreading where the output was at its limits, or NaN.
    renewed_s : float
        Time between two changes of its output where it changes fastest [s]; NaN where it does not change.
    noise : float
        Departure that noise of the device's own measurement alone may cause.
    sample_time_s : float
        Time between two looks at it [s].
    """

    given: PIDController
    departure: float
    misreading: str
    K: float
    Ti_s: float
    Td_s: float
    renewed_s: float
    noise: float
    sample_time_s: float

    @property
    def is_given(self) -> bool:
        """Whether it computes what it was given."""
        return not self.misreading and self.departure <= math.hypot(AGREES, self.noise)

    @property
    def sentence(self) -> str:
        """Say what it computes beside what it was given."""
        given = f"K = {self.given.K:.4g}, T_I = {self.given.Ti_s:.4g} s"
        found = f"K = {self.K:.4g}, T_I = {self.Ti_s:.4g} s"
        if self.renewed_s > 1.5 * self.sample_time_s:
            found += f", renewed every {self.renewed_s:.3g} s"
        if self.is_given:
            return f"the device computes what it was given, {given} (from its own y and u: {found})"
        what = f"the device computes {found}" if math.isfinite(self.K) else "the device computes another law"
        if self.misreading:
            return f"{what} where it was given {given}: {self.misreading}"
        return f"{what} where it was given {given}, and no usual misreading of the gains gives that"


@dataclass(frozen=True, kw_only=True)
class _Law:
    """Parallel gains, and the set-point as the device has it."""

    P: float
    I: float  # noqa: E741 - the field's name
    D: float = 0.0
    Tf_s: float = 0.0
    weight: float = 1.0
    setpoint: Callable[[float], float] = float
    fitted: bool = False


@dataclass(frozen=True, kw_only=True)
class _Estimate:
    """Gains by least squares, with the standard deviations of the proportional and the integral one."""

    law: _Law
    sd: tuple[float, float]

    def allows(self, law: _Law) -> bool:
        """Return whether a law's gains are near these."""
        pairs = zip((self.law.P, self.law.I), (law.P, law.I), self.sd, strict=True)
        return all(abs(own - other) <= UNLIKE * abs(own) + 4.0 * sd for own, other, sd in pairs)


def identify_running_law(
    record: LawRecord,
    given: PIDController,
    *,
    misread: Mapping[str, PIDController] | None = None,
    misread_setpoint: Callable[[float], Mapping[str, float]] | None = None,
) -> RunningLaw:
    """Say which law a controller ran.

    Parameters
    ----------
    record : LawRecord
        What was measured while it ran, from its first row on.
    given : PIDController
        Gains that it was given.
    misread : mapping of str to PIDController, optional
        What it holds where it reads its registers otherwise, by how.
    misread_setpoint : callable, optional
        From a set-point [y unit] to those that it has where it reads that register otherwise, by how.

    Notes
    -----
    The estimate of the gains is least squares on smoothed signals: independent noise of the device's own measurement
    makes K a few per cent too small. A misreading that changes nothing in what was asked cannot be seen.
    """
    usable = np.isfinite(record.y)
    filled = np.interp(np.arange(record.y.size), np.flatnonzero(usable), record.y[usable])
    record = replace(record, y=filled)
    own = _law(given)
    departure, noise, estimate = _departure(record, own, own), _noise(record, own, own), _estimate(record, given)
    candidates = _misreadings(given, misread or {}, misread_setpoint, record, estimate)
    differs = departure > math.hypot(AGREES, noise)
    alike: tuple[str, ...] = ()
    for smoothing in (record.smoothing, max(1, record.smoothing // FINER)) if differs else ():
        alike = alike or _alike(replace(record, smoothing=smoothing), candidates, own, estimate)
    unknown = _Law(P=math.nan, I=math.nan) if differs else own
    shown = candidates[alike[0]] if len(alike) == 1 else estimate.law if estimate is not None else unknown
    return RunningLaw(
        given=given,
        departure=departure,
        misreading=" or ".join(alike),
        K=shown.P,
        Ti_s=_over(shown.P, shown.I),
        Td_s=_over(shown.D, shown.P) if shown.D else 0.0,
        renewed_s=_output_period_s(record),
        noise=noise,
        sample_time_s=record.sample_time_s,
    )


def _alike(record: LawRecord, candidates: Mapping[str, _Law], own: _Law, estimate: _Estimate | None) -> tuple[str, ...]:
    """Return the laws that explain the output much better than the given one, none of them better than the others."""
    found = {name: _beyond_noise(record, law, own) for name, law in candidates.items()}
    best = min(found.values(), default=math.inf)
    if best > min(AGREES, BETTER * _beyond_noise(record, own, own)):
        return ()
    good = [name for name, value in found.items() if value <= min(AGREES, max(ALIKE * best, 0.1 * AGREES))]
    near = [name for name in good if estimate is not None and estimate.allows(candidates[name])]
    # a factor that was fitted to the output explains it by right; a usual misreading that does as well is said first
    usual = [name for name in near or good if not candidates[name].fitted]
    return tuple((usual or near or good)[:MOST_NAMED])


def _law(controller: PIDController) -> _Law:
    K = controller.K
    return _Law(
        P=K,
        I=K / controller.Ti_s if controller.Ti_s else 0.0,
        D=K * controller.Td_s,
        Tf_s=controller.Tf_s,
        weight=controller.setpoint_weight,
    )


def _misreadings(
    given: PIDController,
    misread: Mapping[str, PIDController],
    misread_setpoint: Callable[[float], Mapping[str, float]] | None,
    record: LawRecord,
    estimate: _Estimate | None,
) -> dict[str, _Law]:
    """Return the laws that a device may make of the same numbers, by what is wrong; the usual ones first."""
    law, Ti = _law(given), given.Ti_s
    found = {"the wrong sign: its action is reversed": replace(law, P=-law.P, I=-law.I, D=-law.D)}
    found |= {f"wrong {name}": _law(controller) for name, controller in misread.items()}
    if math.isfinite(Ti) and Ti > 0.0:
        found |= {
            "times in minutes for seconds: they act 60 times as long": replace(law, I=law.I / 60.0, D=60.0 * law.D),
            "times in seconds for minutes: they act a sixtieth as long": replace(law, I=60.0 * law.I, D=law.D / 60.0),
            "the parallel form and not the ideal one: the integral does not get K": replace(
                law, I=math.copysign(1.0 / Ti, law.P), D=math.copysign(given.Td_s, law.P)
            ),
            "the parallel form, T_I taken as the integral gain": replace(law, I=math.copysign(Ti, law.P)),
            "T_I taken as repeats per second": replace(law, I=law.P * Ti),
            "T_I taken as repeats per minute": replace(law, I=law.P * Ti / 60.0),
        }
        if given.Td_s:
            series = 1.0 + given.Td_s / Ti
            found["the series form and not the ideal one"] = replace(law, P=law.P * series)
    factors = dict.fromkeys(_PERCENT, False)
    if estimate is not None:  # the slow part knows it best, where there is one
        pairs = ((estimate.law.P, law.P), (estimate.law.I, law.I))
        ratios = [found / given for found, given in pairs if given and found / given > 0.0]
        unusual = [one for one in ratios if all(abs(one / usual - 1.0) > UNLIKE for usual in (1.0, *_PERCENT))]
        factors |= dict.fromkeys(unusual, True)
    for factor, fitted in factors.items():
        said = f"percent for engineering units, or a wrong scale of the gain: K acts {factor:.3g} times"
        found[said] = replace(law, P=factor * law.P, I=factor * law.I, D=factor * law.D, fitted=fitted)
    found["no proportional action on the set-point"] = replace(law, weight=0.0)
    for scale in _SCALES:
        said = f"a wrong scale of the set-point: the device holds y at {scale:g} times it"
        found[said] = replace(law, setpoint=partial(operator.mul, scale))
    if misread_setpoint is not None:
        table = {float(r): misread_setpoint(float(r)) for r in np.unique(record.r)}
        for name in table[float(record.r[0])]:
            wrong = {r: others.get(name, r) for r, others in table.items()}
            found[f"wrong {name}"] = replace(law, setpoint=wrong.__getitem__)
    return found


def _departure(record: LawRecord, law: _Law, given: _Law) -> float:
    """Return how far a law's output is from the measured one, over the larger of the given one's and its movement."""
    held = {float(r): law.setpoint(float(r)) for r in np.unique(record.r)}
    r = np.array([held[float(value)] for value in record.r])
    measured = _smooth(record.u, record.smoothing)
    found = []
    for late in range(min(LATEST + 1, record.y.size)):  # it may be shown some samples late
        own = _smooth(_ran(record, law, _late(r, late), _late(record.y, late)), record.smoothing)
        found.append(float(np.std(own - measured)))
    return min(found) / _movement(record, given)


def _beyond_noise(record: LawRecord, law: _Law, given: _Law) -> float:
    """Return a law's departure without what noise of the device's own measurement causes: that grows with its gain."""
    return math.sqrt(max(0.0, _departure(record, law, given) ** 2 - _noise(record, law, given) ** 2))


def _movement(record: LawRecord, given: _Law) -> float:
    """Return the larger of the movements of the measured output and the given law's on the measured y [u unit]."""
    own = _smooth(_ran(record, given, record.r, record.y), record.smoothing)
    least = 1e-6 * (record.u_range[1] - record.u_range[0])
    return max(float(np.std(own)), float(np.std(_smooth(record.u, record.smoothing))), least)


def _noise(record: LawRecord, law: _Law, given: _Law) -> float:
    """Return the departure that the noise of y alone may cause, the device's measurement being its own."""
    sd = 1.4826 * float(np.median(np.abs(np.diff(record.y))))  # of the difference of two readings, the plant's apart
    drawn = sd * np.random.default_rng(0).standard_normal(record.y.size)
    still = replace(record, u=np.full(record.u.size, record.u[0]))
    output = _smooth(_ran(still, law, record.r[0] + 0.0 * drawn, record.r[0] + drawn), record.smoothing)
    return min(1.0, float(np.std(output)) / _movement(record, given))


def _ran(record: LawRecord, law: _Law, r: FloatArray, y: FloatArray) -> FloatArray:
    """Return the output of a law on a set-point and a measurement."""
    T_s = record.sample_time_s
    gains = (law.P, law.I * T_s, law.D / T_s, law.weight)
    low, high = record.u_range[0] - record.load, record.u_range[1] - record.load
    output: FloatArray = _output(gains, T_s / (law.Tf_s + T_s), r, y, low, high, float(record.u[0]))
    return output


def _late(values: FloatArray, late: int) -> FloatArray:
    return np.concatenate([np.full(late, values[0]), values[: values.size - late]])


@njit(cache=True)
def _output(
    gains: tuple[float, float, float, float],
    blend: float,
    r: FloatArray,
    y: FloatArray,
    low: FloatArray,
    high: FloatArray,
    start: float,
) -> FloatArray:
    """Return a law's output on a measured y, in velocity form, from where the measured output began."""
    P, slope, lead, weight = gains
    u = np.empty(y.size)
    u[0], filtered, rate = start, y[0], 0.0
    for k in range(1, y.size):
        before, rate_before = filtered, rate
        filtered += blend * (y[k] - filtered)
        rate = filtered - before
        moved = P * (weight * (r[k] - r[k - 1]) - rate) + slope * (r[k] - filtered) - lead * (rate - rate_before)
        u[k] = min(max(u[k - 1] + moved, low[k]), high[k])
    return u


def _estimate(record: LawRecord, given: PIDController) -> _Estimate | None:
    """Return the gains by least squares on smoothed signals; None where the output was at its limits."""
    whole, slack = record.u + record.load, 1e-3 * (record.u_range[1] - record.u_range[0])
    at_limit = np.mean((whole <= record.u_range[0] + slack) | (whole >= record.u_range[1] - slack))
    if at_limit > AT_LIMIT or record.y.size < 20:
        return None
    T_s, n = record.sample_time_s, record.smoothing
    centre = float(record.r[0])
    found = []
    for late in range(LATEST + 1):
        r, y = _late(record.r, late) - centre, _late(record.y, late) - centre
        weight = given.setpoint_weight
        columns = [weight * r - y, T_s * np.cumsum(r - y), np.ones(y.size)]
        if given.Td_s > 0.0:
            columns.append(-np.gradient(y, T_s))
        A = np.stack([_smooth(column, n) for column in columns], axis=1)
        solution, *_ = np.linalg.lstsq(A, _smooth(record.u, n), rcond=None)
        error = float(np.sum((A @ solution - _smooth(record.u, n)) ** 2))
        D = float(solution[3]) if given.Td_s > 0.0 else 0.0
        # neighbouring residuals are one where they were averaged
        variance = error * n / max(1, y.size - n * solution.size) * np.linalg.pinv(A.T @ A).diagonal()
        law = _Law(P=float(solution[0]), I=float(solution[1]), D=D)
        found.append((error, _Estimate(law=law, sd=(math.sqrt(variance[0]), math.sqrt(variance[1])))))
    return min(found, key=lambda pair: pair[0])[1]


def _output_period_s(record: LawRecord) -> float:
    """Return the time between two changes of the output where it changes fastest [s]."""
    changes = np.flatnonzero(np.diff(record.u) != 0.0)
    if changes.size < 5:
        return math.nan
    return float(np.quantile(np.diff(changes), 0.25)) * record.sample_time_s


def _smooth(values: FloatArray, count: int) -> FloatArray:
    smooth: FloatArray = uniform_filter1d(values, count, mode="nearest")
    return smooth


def _over(numerator: float, denominator: float) -> float:
    return numerator / denominator if denominator else math.inf
