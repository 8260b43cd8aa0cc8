"""The control law recomputed: whether the recorded u follows from r and y by the stated law.

A law is a sum of parts, each with a gain: u = K (b r - y) + K/T_I integral(r - y) - K T_d dy/dt for P, PI, PD and PID,
one part, the whole of C(s) or C(q) acting on e = r - y, for a law given as polynomials. What a recording shows are the
gains of the parts, estimated beside a bias, the free response of the law's own states, and a dither that is unknown.

Parts, filters and ways of computing one law belong together: the file is longer than others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import cont2discrete, lfilter

from autotune.arrays import FloatArray
from autotune.controller import Controller, DiscreteController, PIDController
from autotune.diagnosis.evidence.samples import SampleEffect
from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.models import Parameter, TransferFunction
from autotune.recording import Recording

#: Shortest filter of a derivative that is looked for where none is stated, in sample times; the longest is T_d.
SHORTEST_FILTER = 0.05
#: Order of the autoregressive noise that the dither is taken for.
ORDER = 8
EQUATIONS = {
    ("gain",): "u = bias + g C e with a gain g other than 1",
    ("P",): "u = bias + K e with K other than stated",
    ("P", "I"): "u = bias + K (e + integral(e)/T_I) with K and T_I other than stated",
    ("P", "D"): "u = bias + K (e - T_d dy/dt) with K and T_d other than stated",
    ("P", "I", "D"): "u = bias + K (e + integral(e)/T_I - T_d dy/dt) with K, T_I and T_d other than stated",
}


@dataclass(frozen=True, kw_only=True)
class StatedLaw:
    """A law as stated; ``filtered`` says whether the filter of its derivative is stated as well."""

    controller: Controller
    filtered: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownLaw:
    """A stated law beside what a recording shows of it.

    Attributes
    ----------
    parts : tuple of str
        ``gain`` for a law as a whole, else ``P``, ``I``, ``D`` as far as it has them.
    ratio, sd : (P,) array
        Gains that the recording shows over the stated ones, and their 1-sigma.
    recomputed : (N,) array
        u by the stated law, bias and the law's own start states fitted.
    clear : bool
        False where a derivative's filter that is not stated explains nearly as much as other gains do.
    filtered : bool
        Whether the filter is stated.
    least_change : float
        Share of a gain that counts as a change.
    """

    parts: tuple[str, ...]
    ratio: FloatArray
    sd: FloatArray
    recomputed: FloatArray
    clear: bool
    filtered: bool
    least_change: float

    @property
    def off(self) -> FloatArray:
        """How far each gain is from the stated one in standard deviations; 0 where that is too little to count."""
        change = np.abs(self.ratio - 1.0)
        return np.where(self.clear & (change > self.least_change), change / np.maximum(self.sd, 1e-300), 0.0)

    @property
    def factors(self) -> dict[str, Parameter]:
        """Gain and times as factors of the stated ones."""
        found = {"gain_factor": Parameter(value=float(self.ratio[0]), sd=float(self.sd[0]), unit="-")}
        for part, ratio, sd in zip(self.parts[1:], self.ratio[1:], self.sd[1:], strict=True):
            name, factor = (
                ("T_I_factor", self.ratio[0] / ratio) if part == "I" else ("T_d_factor", ratio / self.ratio[0])
            )
            known = part == "I" or self.filtered  # a filter that is not stated takes its share of T_d
            spread = math.nan if not known else abs(factor) * np.hypot(self.sd[0] / self.ratio[0], sd / ratio)
            found[name] = Parameter(value=float(factor), sd=float(spread), unit="-")
        return found


@dataclass(frozen=True, kw_only=True, eq=False)
class _Columns:
    """What each part of a law makes of a recording, (N, P), with its stated gain, and what its free states add."""

    parts: tuple[str, ...]
    aims: FloatArray
    driven: FloatArray
    free: FloatArray


#: A law's columns as a function of the time constant of a filter that is not stated [s].
Way: TypeAlias = Callable[[float], _Columns]


def law_effect(
    recordings: Sequence[Recording], controller: Controller | None = None, limits: Thresholds = IN_USE
) -> SampleEffect | None:
    """Return the mismatch of the control law where u recomputed from r and y differs from the recorded u.

    Parameters
    ----------
    recordings : sequence of Recording
        Those with a set-point column ``r`` are looked at.
    controller : Controller, optional
        The stated law; the sidecar's ``[controller]`` by default, see :func:`stated_law`.
    limits : Thresholds
        What decides between two findings.

    Returns
    -------
    SampleEffect or None
        ``controller.law`` with the gain and the times that a recording shows, as factors of the stated.
    """
    for r in recordings:
        stated = stated_law(r.metadata, controller)
        shown = None if stated is None else shown_law(r, stated, limits)
        if shown is not None and np.max(shown.off) ** 2 > limits.beyond_chance:
            return SampleEffect(
                name="controller.law",
                equation=EQUATIONS[shown.parts],
                parameters=shown.factors,
                evidence=float(np.max(shown.off) ** 2),
            )
    return None


def stated_law(metadata: Mapping[str, Any], controller: Controller | None) -> StatedLaw | None:
    """Return the law that the user or a sidecar states; nothing where it is none that can be recomputed.

    A sidecar's ``[controller]`` has ``kind`` P, PI, PD or PID with ``K``, ``T_I`` and ``T_d`` (or ``Ti_s``, ``Td_s``),
    or ``num`` and ``den`` as in a controller file.
    """
    if controller is not None:
        return StatedLaw(controller=controller, filtered=True)
    given = metadata.get("controller", {})
    if not isinstance(given, Mapping):
        return None
    if "num" in given and "den" in given:
        num, den = (tuple(float(x) for x in given[key]) for key in ("num", "den"))
        if "sample_time_s" not in given:
            return StatedLaw(controller=TransferFunction(num=num, den=den), filtered=True)
        sampled = DiscreteController(num=num, den=den, sample_time_s=float(given["sample_time_s"]))
        return StatedLaw(controller=sampled, filtered=True)
    if str(given.get("kind", "")).upper() not in ("P", "PI", "PD", "PID") or "K" not in given:
        return None
    Ti = float(given.get("T_I", given.get("Ti_s", math.inf)) or math.inf)
    Td = float(given.get("T_d", given.get("Td_s", 0.0)))
    Tf = given.get("T_f", given.get("Tf_s"))
    law = PIDController(K=float(given["K"]), Ti_s=Ti, Td_s=Td, Tf_s=float(Tf or 0.0))
    return StatedLaw(controller=law, filtered=Tf is not None)


def shown_law(r: Recording, stated: StatedLaw, limits: Thresholds = IN_USE) -> ShownLaw | None:
    """Return what a recording shows of a stated law.

    Parameters
    ----------
    r : Recording
        With its set-point in the column ``r``.
    stated : StatedLaw
        What it is compared with.
    limits : Thresholds
        What decides between two findings.

    Returns
    -------
    ShownLaw or None
        Nothing without a set-point, with a u that stands at its limit, or for a law that no recording of this sample
        time can show (a gain of zero, another sample time, more zeros than poles).

    Notes
    -----
    Least squares with the dither's colour taken for an AR(8) noise. A row's command may follow from that row's sample
    or, where command and sample are exchanged at one instant, from the one before; a derivative may be one of y or of
    e, and the filter that it has, alone or with the whole measurement, is hardly ever stated, nor how a law in s was
    made one of samples: the rows themselves say which, by what is left unexplained. In closed loop the estimate is free
    of bias as far as the dither is white after its AR(8); T_d is known up to what the filter's form makes of it.
    """
    limited = float(np.mean((r.u == r.u.min()) | (r.u == r.u.max())))
    if "r" not in r.extra or not np.all(np.isfinite(r["r"])) or limited > limits.law_most_at_limits:
        return None
    ways = _ways(stated, r)
    if not ways:
        return None
    law, Ts = stated.controller, r.sample_time_s
    longest = law.Td_s if isinstance(law, PIDController) and not stated.filtered else 0.0
    sought = longest > 0.0
    tried = (_of(way, late, r.u, longest, Ts, free=not sought) for way in ways for late in (0, 1))
    best = min(tried, key=lambda one: one.left)
    found = _of(best.way, best.late, r.u, longest, Ts, free=True) if sought else best
    columns = found.columns
    return ShownLaw(
        parts=columns.parts,
        ratio=found.gains / columns.aims,
        sd=found.sd / np.abs(columns.aims),
        recomputed=_stated_commands(best, r.u),
        clear=not sought or best.left > limits.clearly_more * found.left,
        filtered=not sought,
        least_change=limits.law_least_change,
    )


def _ways(stated: StatedLaw, r: Recording) -> list[Way]:
    """Return the ways in which a law may have been computed, each a function of a time constant that is not stated."""
    law, Ts = stated.controller, r.sample_time_s
    y = np.where(np.isfinite(r.y), r.y, r["r"])

    def fixed(whole: _Columns) -> Way:
        return lambda _: whole

    if not isinstance(law, PIDController):
        return [fixed(_whole(num, den, r["r"] - y)) for num, den in _polynomials(law, Ts) if np.any(num)]
    if law.K == 0.0:
        return []

    def measured(Tf: float) -> _Columns:
        return _parts(law, r.t, r["r"], _lagged(y, Tf, Ts), None)

    if stated.filtered:
        return [lambda _: measured(law.Tf_s)]
    return [
        measured,
        lambda Tf: _parts(law, r.t, r["r"], y, _lagged(y, Tf, Ts)),
        lambda Tf: _parts(law, r.t, r["r"], y, _lagged(y - r["r"], Tf, Ts)),
    ][: 3 if law.Td_s > 0.0 else 1]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Computed:
    """One way to compute a law, commands ``late`` rows after their samples, with the variance that it leaves."""

    way: Way
    late: int
    columns: _Columns
    gains: FloatArray
    sd: FloatArray
    left: float


def _of(way: Way, late: int, u: FloatArray, longest: float, Ts: float, free: bool) -> _Computed:
    """Compute a law in one way, its gains as stated or free, its filter the one that leaves least."""

    def computed(Tf: float) -> _Computed:
        columns = way(Tf)
        driven, rest = columns.driven[: u.size - late], columns.free[: u.size - late]
        if not free:
            left = _least_squares(rest, u[late:] - driven @ columns.aims)[2]
            return _Computed(
                way=way, late=late, columns=columns, gains=columns.aims, sd=np.zeros(columns.aims.size), left=left
            )
        weights, covariance, left = _least_squares(np.column_stack([driven, rest]), u[late:])
        count = columns.aims.size
        sd = np.sqrt(np.maximum(np.diag(covariance)[:count], 0.0))
        return _Computed(way=way, late=late, columns=columns, gains=weights[:count], sd=sd, left=left)

    return computed(_best_filter(lambda Tf: computed(Tf).left, longest, Ts) if longest > 0.0 else 0.0)


def _stated_commands(law: _Computed, u: FloatArray) -> FloatArray:
    """Return a stated law's commands, bias and its own start states fitted to the recorded ones."""
    driven = law.columns.driven @ law.columns.aims
    driven = np.concatenate([np.full(law.late, driven[0]), driven[: u.size - law.late]])
    return np.asarray(driven + law.columns.free @ np.linalg.lstsq(law.columns.free, u - driven, rcond=None)[0])


def _best_filter(left: Callable[[float], float], longest: float, Ts: float) -> float:
    """Return the time constant of a derivative's filter that leaves least."""
    span = (math.log(SHORTEST_FILTER * Ts), math.log(max(longest, Ts)))
    found = minimize_scalar(
        lambda x: math.log(left(math.exp(x))), method="bounded", bounds=span, options={"xatol": 1e-3}
    )
    return math.exp(float(found.x))


def _parts(law: PIDController, t: FloatArray, r: FloatArray, y: FloatArray, slope_of: FloatArray | None) -> _Columns:
    """Return P, I and D of a law on a measurement; the slope is the measurement's unless another signal is given."""
    parts, aims, columns = ["P"], [law.K], [law.setpoint_weight * r - y]
    if math.isfinite(law.Ti_s):
        e = r - y
        parts.append("I")
        aims.append(law.K / law.Ti_s)
        columns.append(np.concatenate([[0.0], np.cumsum(0.5 * (e[1:] + e[:-1]) * np.diff(t))]))
    if law.Td_s > 0.0:
        rate = np.diff(y if slope_of is None else slope_of) / np.diff(t)
        parts.append("D")
        aims.append(law.K * law.Td_s)
        columns.append(-np.concatenate([rate[:1], rate]))
    return _Columns(parts=tuple(parts), aims=np.array(aims), driven=np.column_stack(columns), free=np.ones((t.size, 1)))


def _polynomials(law: TransferFunction | DiscreteController, Ts: float) -> list[tuple[FloatArray, FloatArray]]:
    """Return numerators and denominators in ascending powers of the delay operator; a law in s has several."""
    if isinstance(law, DiscreteController):
        return [(np.array(law.num), np.array(law.den))] if abs(law.sample_time_s - Ts) <= 0.01 * Ts else []
    num, den = (np.trim_zeros(np.array(p, dtype=np.float64), "f") for p in (law.num, law.den))
    if not num.size or num.size > den.size:
        return []
    made = (cont2discrete((num, den), Ts, method) for method in ("bilinear", "backward_diff", "zoh"))
    return [(np.ravel(b), np.asarray(a)) for b, a, _ in made]


def _whole(num: FloatArray, den: FloatArray, e: FloatArray) -> _Columns:
    """Return a rational law's answer to e from rest, and the free responses of its states."""
    impulse = np.zeros(e.size)
    impulse[0] = 1.0
    free = [np.ones(e.size), *(lfilter([0.0] * late + [1.0], den, impulse) for late in range(len(den) - 1))]
    driven = lfilter(num, den, e)
    return _Columns(parts=("gain",), aims=np.ones(1), driven=driven[:, None], free=np.column_stack(free))


def _lagged(y: FloatArray, Tf: float, Ts: float) -> FloatArray:
    """Return a signal behind a first-order filter by the backward difference, at rest at its first row."""
    keep = Tf / (Tf + Ts)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], y, zi=[keep * y[0]])[0])


def _least_squares(X: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return the columns' weights, their covariance, and the variance left, the noise taken for an AR(8)."""
    weights = np.linalg.lstsq(X, u, rcond=None)[0]
    for _ in range(3):
        residual = u - X @ weights
        filtered = _prewhitening(residual)
        Xw = lfilter(filtered, [1.0], X, axis=0)[filtered.size :]
        uw = lfilter(filtered, [1.0], u)[filtered.size :]
        weights = np.linalg.lstsq(Xw, uw, rcond=None)[0]
    left = uw - Xw @ weights
    variance = float(left @ left) / max(left.size - X.shape[1], 1)
    covariance = np.linalg.pinv(Xw.T @ Xw) * variance
    return np.asarray(weights), np.asarray(covariance), max(variance, 1e-300)


def _prewhitening(residual: FloatArray) -> FloatArray:
    """Return 1, -a1, ..., the filter that whitens a residual, by least squares."""
    past = np.column_stack([residual[ORDER - k - 1 : residual.size - k - 1] for k in range(ORDER)])
    a = np.linalg.lstsq(past, residual[ORDER:], rcond=1e-10)[0]
    return np.concatenate([[1.0], -a])
