"""Beyond the catalogue: what is missing described as a function of the physical signals, without naming a cause.

To first order the simulation error of a fit is the linear chain's response to what is missing: e = G f(s), with f
added at the command, at the plant's input or to the reading, and s a signal of the fitted simulation. Every candidate
function is therefore sent through the chain from there to the reading, window by window, and nothing is ever
differentiated; what start states and the fit's own free numbers could explain is taken out before anything is credited.

Records of what is said, and how it is found: the file is a little longer than others.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

from autotune.arrays import FloatArray
from autotune.diagnosis.evidence.residual import DIRECTION, FreedResidual, ridge
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.models import Place

#: Most terms that a person can still read as one equation.
MOST_TERMS = 3
#: Segments of a curve, and the smoothing weights that are tried, relative to the data's own curvature.
SEGMENTS = 8
SMOOTHINGS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
#: Weight that pulls a curve to zero: it holds what the model's own numbers explain as well, such as a straight line.
LEVEL = 1e-3
#: Share of a signal's size within which its sign passes through zero.
SOFT_SIGN = 0.02
#: Delays of a reading that are tried: how many, the shortest in rows, and the longest as a fraction of a window.
DELAYS, SHORTEST_DELAY, DELAYS_PER_WINDOW = 16, 4.0, 3.0
_ADDS_TO = {"actuator": "the command", "plant": "the plant's input", "sensor": "the reading"}


@dataclass(frozen=True, kw_only=True)
class Term:
    """One term of the equation: ``value`` times the function ``text`` of physical signals, with its 1-sigma."""

    text: str
    value: float
    sd: float
    unit: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A smoothing spline: what is missing over one signal, its mean taken off since an offset explains it.

    Attributes
    ----------
    signal, unit : str
        Signal that it is drawn over, and the unit of the value.
    x, value, sd : (K,) array
        Signal, missing value and its 1-sigma there.
    explained : float
        Share of the held-out residual above the noise that the curve takes away.
    """

    signal: str
    unit: str
    place: Place
    x: FloatArray
    value: FloatArray
    sd: FloatArray
    explained: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Description:
    """A description, not a cause, of what a retuned model leaves.

    Attributes
    ----------
    place : str
        Where the terms are added to the model: ``actuator``, ``plant`` or ``sensor``.
    terms : tuple of Term
        The equation's terms, the most informative first; none where no simple function describes the residual.
    explained : float
        Share of the held-out residual above the noise that the equation takes away, 0 to 1.
    curve : Curve
        The shape over the signal that tells most, without any assumed form.
    shares : mapping
        Held-out share that a free curve takes away, by "signal, at place", largest first.
    """

    place: Place
    terms: tuple[Term, ...]
    explained: float
    curve: Curve
    shares: dict[str, float]

    @property
    def equation(self) -> str:
        """The terms as a person writes them."""
        if not self.terms:
            return "no simple function of the signals describes what is missing"
        sides = [f"{t.value:+.3g} {t.text}" for t in self.terms]
        text = " ".join(f"{side[0]} {side[1:]}" for side in sides).removeprefix("+ ")
        return f"missing at {_ADDS_TO[self.place]}: {text} [{self.terms[0].unit}]"

    @property
    def sentence(self) -> str:
        """What a reader is told."""
        if not self.terms:
            return f"{self.equation.capitalize()}."
        return (
            f"A description, not a cause: {self.equation}; it takes away {100 * self.explained:.0f} % of the residual "
            "above the noise on windows that it was not fitted to."
        )

    def as_json(self) -> dict[str, Any]:
        """Return the content of the key ``description`` of diagnosis.json."""
        return {
            "note": "a description, not a cause",
            "equation": self.equation,
            "adds_to": _ADDS_TO[self.place],
            "terms": [{"term": t.text, "value": t.value, "sd": t.sd, "unit": t.unit} for t in self.terms],
            "held_out_explained": self.explained,
            "curve": {
                "signal": self.curve.signal,
                "adds_to": _ADDS_TO[self.curve.place],
                "unit": self.curve.unit,
                "x": self.curve.x.tolist(),
                "value": self.curve.value.tolist(),
                "sd": self.curve.sd.tolist(),
                "held_out_explained": self.curve.explained,
            },
            "signals": self.shares,
        }


def describe(result: Fit, data: Data) -> Description:
    """Describe what a fit leaves as a function of its signals.

    Parameters
    ----------
    result : Fit
        The retuned nominal structure.
    data : Data
        What it was fitted to.

    Returns
    -------
    Description
        A sparse equation (the best of all subsets on held-out windows) and a smoothing spline with its band.

    Notes
    -----
    First order: but for a position, which follows the readings, the signals are those of the fitted simulation; shapes
    are smeared by as much as these differ from the rig's, and sizes are biased by what retuning has moved. A part that
    the model's own free numbers can explain (an offset, a straight line in speed or input) is not seen. Where u is fed
    back from y, both contain the noise; windows that were not fitted tell whether that matters.

    References
    ----------
    .. [1] P. H. C. Eilers and B. D. Marx, "Flexible smoothing with B-splines and penalties", Statist. Sci. 11, 1996.
    .. [2] S. L. Brunton, J. L. Proctor and J. N. Kutz, "Discovering governing equations from data by sparse
       identification of nonlinear dynamical systems", PNAS 113, 2016; here on simulation errors, not on derivatives.
    """
    residual = FreedResidual(result, data)
    curves = sorted(_curves(residual), key=lambda c: -c.explained)
    terms, place, explained = _equation(residual)
    shares = {f"{c.signal}, added to {_ADDS_TO[c.place]}": round(c.explained, 3) for c in curves}
    return Description(
        place=place if terms else curves[0].place,
        terms=terms,
        explained=explained,
        curve=curves[0],
        shares=shares,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Candidate:
    """A function with the factor that takes its coefficient from the scaled signals to physical units."""

    place: Place
    text: str
    unit: str
    factor: float
    column: FloatArray


_SHAPES: tuple[tuple[str, int, Callable[[FloatArray], FloatArray]], ...] = (
    ("{}", 1, lambda s: s),
    ("{}^2", 2, lambda s: s**2),
    ("{}^3", 3, lambda s: s**3),
    ("|{}|", 1, np.abs),
    ("{0} |{0}|", 2, lambda s: s * np.abs(s)),
    ("sign({})", 0, lambda s: np.clip(s / SOFT_SIGN, -1.0, 1.0)),
)


def _candidate(
    residual: FreedResidual, place: Place, text: str, values: Sequence[FloatArray], factor: float
) -> _Candidate:  # fmt: skip
    """Return a function with its values, (N,) per recording, sent through the chain from where it is added."""
    unit, column = residual.unit[place], residual.shown(place, values)
    return _Candidate(place=place, text=text, unit=unit, factor=factor, column=column)


def _size(values: Sequence[FloatArray]) -> float:
    return float(np.quantile(np.abs(np.concatenate(values)), 0.98)) or 1.0


def _candidates(residual: FreedResidual) -> Iterator[_Candidate]:
    """Yield the dictionary: shapes of single signals, products of two, and time."""
    for place, group in residual.signals.items():
        for name, values in group.items():
            size = _size(values)
            for text, power, shape in _SHAPES if name != DIRECTION else _SHAPES[:1]:
                yield _candidate(residual, place, text.format(name), [shape(s / size) for s in values], size**-power)
        for (a, x), (b, z) in itertools.combinations(group.items(), 2) if place == "plant" else ():
            size = _size(x) * _size(z)
            product = [p * q / size for p, q in zip(x, z, strict=True)]
            yield _candidate(residual, place, f"{a} * {b}", product, 1.0 / size)
        clock = [r.t - r.t[0] for r in residual.data.recordings]
        yield _candidate(residual, place, "time", [t / _size(clock) for t in clock], 1.0 / _size(clock))


def _memories(residual: FreedResidual) -> Iterator[_Candidate]:
    """Yield what a sensor may add that no function of one instant is: readings of some time before, and the command.

    The command is the one held while the reading was taken: that of the row itself follows the reading's noise.
    """
    data, values = residual.data, residual.signals["sensor"].get("reading")
    held = [np.concatenate([r.u[:1], r.u[:-1]]) - residual.result.sim.u_offset for r in data.recordings]
    if np.ptp(np.concatenate(held)) > 0.0:
        size = _size(held)
        yield _candidate(residual, "sensor", "command", [w / size for w in held], 1.0 / size)
    if values is None:
        return
    Ts, size = data.sample_times[0], _size(values)
    longest = max(int(np.max(b - a)) for a, b in zip(data.starts, data.stops, strict=True)) * Ts / DELAYS_PER_WINDOW
    for delay in np.geomspace(SHORTEST_DELAY * Ts, max(longest, 2.0 * SHORTEST_DELAY * Ts), DELAYS):
        before = [np.interp(r.t - delay, r.t, y) / size for r, y in zip(data.recordings, values, strict=True)]
        yield _candidate(residual, "sensor", f"(reading {delay:.3g} s before)", before, 1.0 / size)


def _equation(residual: FreedResidual) -> tuple[tuple[Term, ...], Place, float]:
    """Select up to three terms of one place and kind, as long as held-out windows ask for one more."""
    pool, memories = (
        [c for c in some if residual.is_new(c.column)] for some in (_candidates(residual), _memories(residual))
    )
    before = residual.cross_validated(np.zeros((residual.e.size, 0)))
    limits = residual.data.thresholds
    least = max(limits.material * (before - residual.floor), limits.beyond_chance)
    chosen: list[_Candidate] = []
    error = before
    groups = [*([c for c in pool if c.place == place] for place in residual.signals), memories]
    for size in range(1, MOST_TERMS + 1):
        found, i = min(
            (residual.best_subset([c.column for c in group], size), i)
            for i, group in enumerate(groups)
            if len(group) >= size
        )
        if error - found[0] < least:
            break
        error, chosen = found[0], [groups[i][k] for k in found[1]]
    if not chosen:
        return (), "plant", 0.0
    alone = [residual.best_subset([c.column], 1)[0] for c in chosen]
    chosen = [chosen[i] for i in np.argsort(alone)]
    X = np.column_stack([residual.J, *(c.column for c in chosen)])
    beta, inverse = ridge(X, residual.e, np.zeros((X.shape[1], X.shape[1])))
    left = residual.e - X @ beta
    spread = np.sqrt(np.diag(inverse) * max(1.0, float(left @ left) / max(residual.rows - X.shape[1], 1)))
    first = residual.J.shape[1]
    terms = tuple(
        Term(text=c.text, value=float(beta[first + i] * c.factor), sd=float(spread[first + i] * c.factor), unit=c.unit)
        for i, c in enumerate(chosen)
    )
    return terms, chosen[0].place, residual.explained(error, before)


def _curves(residual: FreedResidual) -> Iterator[Curve]:
    """Yield a smoothing spline over every signal."""
    before = residual.cross_validated(np.zeros((residual.e.size, 0)))
    second = np.diff(np.eye(SEGMENTS + 3), 2, axis=0)
    for place, group in residual.signals.items():
        for name, values in group.items():
            if name == DIRECTION:
                continue
            low, high = np.quantile(np.concatenate(values), [0.005, 0.995])
            knots = low + (high - low) / SEGMENTS * np.arange(-3, SEGMENTS + 4)

            def spline(s: FloatArray, knots: FloatArray = knots, low: float = low, high: float = high) -> FloatArray:
                inside = np.clip(s, low, high - 1e-9 * (high - low))
                return np.asarray(BSpline.design_matrix(inside, knots, 3).toarray())

            rows = [spline(s) for s in values]
            X = np.column_stack([residual.shown(place, [B[:, k] for B in rows]) for k in range(SEGMENTS + 3)])
            weight = float(np.sum(X**2)) / X.shape[1]
            penalties = [weight * (s * second.T @ second + LEVEL * np.eye(X.shape[1])) for s in SMOOTHINGS]
            error, best = min((residual.cross_validated(X, P), i) for i, P in enumerate(penalties))
            penalty = np.zeros((residual.J.shape[1] + X.shape[1],) * 2)
            penalty[residual.J.shape[1] :, residual.J.shape[1] :] = penalties[best]
            beta, inverse = ridge(np.column_stack([residual.J, X]), residual.e, penalty)
            x = np.linspace(low, high, 61)
            B = spline(x)
            B = B - B.mean(axis=0)
            first = residual.J.shape[1]
            sd = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", B, inverse[first:, first:], B), 0.0))
            excess = np.sqrt(max(1.0, error / residual.rows))
            yield Curve(
                signal=name, unit=residual.unit[place], place=place, x=x, value=B @ beta[first:], sd=excess * sd,
                explained=residual.explained(error, before),
            )  # fmt: skip
