"""Beyond the catalogue: what is missing described as a function of the physical signals, without naming a cause.

To first order the simulation error of a fit is the linear chain's response to what is missing: e = G f(s), with f
added at the command, at the plant's input or to the reading, and s a signal of the fitted simulation. Every candidate
function is therefore sent through the chain from there to the reading, window by window, and nothing is ever
differentiated; what start states and the fit's own free numbers could explain is taken out before anything is credited.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from scipy.interpolate import BSpline
from scipy.signal import savgol_filter

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis import kernel
from autotune.diagnosis.data import Data
from autotune.diagnosis.fitting import Fit
from autotune.diagnosis.selection import LEAST_DECREASE
from autotune.diagnosis.simulation import Simulator

Place: TypeAlias = Literal["actuator", "plant", "sensor"]
#: Most terms that a person can still read as one equation.
MOST_TERMS = 3
#: Least share of the held-out misfit above the noise that one more term must take away.
LEAST_SHARE = 0.1
#: Least share of a function's power that the model's own numbers cannot imitate.
NEW = 1e-3
#: Segments of a curve, and the smoothing weights that are tried, relative to the data's own curvature.
SEGMENTS = 8
SMOOTHINGS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
#: Weight that pulls a curve to zero: it holds what the model's own numbers explain as well, such as a straight line.
LEVEL = 1e-3
#: Ridge on unit columns while subsets are compared.
RIDGE = 1e-7
#: Share of a signal's size within which its sign passes through zero.
SOFT_SIGN = 0.02
#: Half-width of the smoothing of residuals, in lags of the plant.
SMOOTH_LAGS = 0.25
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
        Share of the held-out misfit above the noise that the curve takes away.
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
        The equation's terms, the most telling first; none where no simple function describes the residual.
    explained : float
        Share of the held-out misfit above the noise that the equation takes away, 0 to 1.
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
            f"A description, not a cause: {self.equation}; it takes away {100 * self.explained:.0f} % of the misfit "
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
    are smeared by as much as these differ from the rig's, and sizes are biased by what retuning has bent. A part that
    the model's own free numbers can explain (an offset, a straight line in speed or input) is not seen. Where u is fed
    back from y, both contain the noise; windows that were not fitted tell whether that matters.

    References
    ----------
    .. [1] P. H. C. Eilers and B. D. Marx, "Flexible smoothing with B-splines and penalties", Statist. Sci. 11, 1996.
    .. [2] S. L. Brunton, J. L. Proctor and J. N. Kutz, "Discovering governing equations from data by sparse
       identification of nonlinear dynamical systems", PNAS 113, 2016; here on simulation errors, not on derivatives.
    """
    scene = _Scene(result, data)
    curves = sorted(_curves(scene), key=lambda c: -c.explained)
    terms, place, explained = _equation(scene)
    shares = {f"{c.signal}, added to {_ADDS_TO[c.place]}": round(c.explained, 3) for c in curves}
    return Description(
        place=place if terms else curves[0].place,
        terms=terms,
        explained=explained,
        curve=curves[0],
        shares=shares,
    )


class _Scene:
    """The residual, and how a missing signal shows in it."""

    def __init__(self, result: Fit, data: Data) -> None:
        self.result, self.data = result, data
        self.e = self.freed(result.e)
        self.J = self.freed(result.jacobian[0])
        self._own = np.linalg.svd(self.J / np.maximum(np.linalg.norm(self.J, axis=0), 1e-300), full_matrices=False)[0]
        self.rows = data.rows
        number = np.zeros(result.e.size, dtype=np.int64)
        for i, (a, b) in enumerate(result.windows):
            number[a:b] = i
        # few windows may go by direction, one and one: blocks of two are taken
        self.first_half: BoolArray = (number // 2) % 2 == 0
        model = result.parametrisation.model
        at_plant = next((b.unit for b in model.blocks if b.place == "actuator" and b.unit), model.input.unit)
        self.unit = {"actuator": model.input.unit, "plant": at_plant, "sensor": model.output.unit}
        self.signals = self._signals()
        none = np.zeros(kernel.SLOTS, dtype=np.int64)
        plain = replace(
            result.sim, E=np.zeros(kernel.SLOTS), on=none, forced=False, u_offset=0.0, y_offset=0.0, linear_hold=False,
            falling=result.sim.chain,
        )  # fmt: skip
        chain = result.sim.chain
        force = np.zeros_like(chain.B)
        force[:, 0] = chain.B[:, 1]
        gains = np.array([chain.gains[0], chain.gains[1], 0.0, 0.0])
        forced = replace(chain, B=force, gains=gains, delay_s=0.0)
        self._ways: dict[Place, Simulator] = {
            "actuator": plain, "plant": replace(plain, chain=forced, falling=forced)
        }  # fmt: skip

    def freed(self, direction: FloatArray) -> FloatArray:
        """Return a whitened direction, (N,) or (N, q), without what the windows' start states explain."""
        left = direction.copy()
        for (a, b), Q in zip(self.result.windows, self.result.states_explain, strict=True):
            left[a:b] -= Q @ (Q.T @ left[a:b])
        return left

    def shown(self, place: Place, missing: Sequence[FloatArray]) -> FloatArray:
        """Return how a missing signal, (N,) per recording, shows in the whitened residual, start states freed."""
        rows = []
        order = self.result.sim.chain.order
        for r, s, ok, starts, stops in zip(
            self.data.recordings, missing, self.data.good, self.data.starts, self.data.stops, strict=True
        ):
            if place == "sensor":
                out = s
            else:
                driven = replace(r, u=s, extra={})
                out = self._ways[place].run(driven, np.zeros((len(starts), order)), starts, stops=stops)[:, 0]
            rows.append(np.where(ok, out, 0.0))
        return self.freed(np.concatenate(self.data.whitened(rows)))

    def is_new(self, column: FloatArray) -> bool:
        """Whether a direction is more than what the model's own numbers can do."""
        left = column - self._own @ (self._own.T @ column)
        return bool(left @ left > NEW * (column @ column))

    def _signals(self) -> dict[Place, dict[str, list[FloatArray]]]:
        """Return the signals that something missing may depend on, per place and recording; silent ones left out.

        Where the simulation is wrong its output is too: a position follows the readings, by the simulation plus its
        smoothed residual. A speed or level may not: a low-passed reading explains itself.
        """
        sim, data = self.result.sim, self.data
        out = [np.nan_to_num(s) for s in self.result.signals]
        command = [r.u - sim.u_offset for r in data.recordings]
        plant = {"level": [s[:, 2] for s in out], "plant input": [s[:, 3] for s in out]}
        if sim.chain.is_mechanical:
            lag = 1.0 / float(np.max(np.abs(np.linalg.eigvals(sim.chain.A[sim.chain.plant, sim.chain.plant]))))
            smooth = [
                _smoothed(e, a, b, round(SMOOTH_LAGS * lag / r.sample_time_s))
                for e, a, b, r in zip(self.result.residuals, data.starts, data.stops, data.recordings, strict=True)
            ]
            position = [s[:, 2] + e for s, e in zip(out, smooth, strict=True)]
            plant = {"speed": [s[:, 1] for s in out], "position": position, "plant input": plant["plant input"]}
        rate = [np.gradient(s[:, 0], r.t) for s, r in zip(out, data.recordings, strict=True)]
        named: dict[Place, dict[str, list[FloatArray]]] = {
            "plant": plant,
            "actuator": {"command": command, "direction of the command": [_last_move(u) for u in command]},
            "sensor": {"reading": [s[:, 0] - sim.y_offset for s in out], "rate of the reading": rate},
        }
        return {
            p: {name: values for name, values in group.items() if np.ptp(np.concatenate(values)) > 0.0}
            for p, group in named.items()
        }

    def cross_validated(self, columns: FloatArray, penalty: FloatArray | None = None) -> float:
        """Return the squared error on each half of the windows with numbers fitted to the other half."""
        X = np.column_stack([self.J, columns])
        P = np.zeros((X.shape[1], X.shape[1]))
        if penalty is not None:
            P[self.J.shape[1] :, self.J.shape[1] :] = penalty
        total = 0.0
        for train in (self.first_half, ~self.first_half):
            beta = _ridge(X[train], self.e[train], P)[0]
            left = self.e[~train] - X[~train] @ beta
            total += float(left @ left)
        return total

    def best_subset(self, columns: Sequence[FloatArray], size: int) -> tuple[float, tuple[int, ...]]:
        """Return the least cross-validated error of all subsets of a size, and the subset."""
        X, p = np.column_stack([self.J, *columns]), self.J.shape[1]
        norms = np.linalg.norm(X, axis=0)
        X = X / np.where(norms > 0.0, norms, 1.0)
        subsets = list(itertools.combinations(range(len(columns)), size))
        index = np.array([[*range(p), *(p + k for k in subset)] for subset in subsets])
        total = np.zeros(len(subsets))
        for train in (self.first_half, ~self.first_half):
            (H, g), (H_test, g_test) = ((X[h].T @ X[h], X[h].T @ self.e[h]) for h in (train, ~train))
            # a hair of ridge: what collinear functions share is theirs together
            H = H + RIDGE * np.eye(len(g))
            beta = np.linalg.solve(H[index[:, :, None], index[:, None, :]], g[index][..., None])[..., 0]
            test = H_test[index[:, :, None], index[:, None, :]]
            rest = self.e[~train]
            total += rest @ rest - 2.0 * np.sum(beta * g_test[index], axis=1)
            total += np.einsum("si,sij,sj->s", beta, test, beta)
        best = int(np.argmin(total))
        return float(total[best]), subsets[best]

    def explained(self, error: float, before: float) -> float:
        """Return the share of the held-out misfit above the noise that is gone."""
        return float(np.clip((before - error) / max(before - self.rows, LEAST_SHARE * self.rows), 0.0, 1.0))


def _smoothed(e: FloatArray, starts: IntArray, stops: IntArray, rows: int) -> FloatArray:
    """Return a residual smoothed within each window by local parabolas."""
    value = np.zeros_like(e)
    for a, b in zip(starts, stops, strict=True):
        width = min(max(7, 2 * rows + 1), (b - a - 1) // 2 * 2 + 1)
        if width >= 5:
            value[a:b] = savgol_filter(e[a:b], width, 2)
    return value


def _last_move(u: FloatArray) -> FloatArray:
    """Return the sign of the command's last change, 0 before the first."""
    sign = np.sign(np.diff(u, prepend=u[0]))
    last = np.maximum.accumulate(np.where(sign != 0.0, np.arange(u.size), 0))
    return np.asarray(sign[last])


def _ridge(X: FloatArray, e: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the penalised least-squares estimate and the inverse of its normal matrix, null directions left at 0."""
    scale = np.linalg.norm(X, axis=0)
    scale[scale == 0.0] = 1.0
    H = (X / scale).T @ (X / scale) + P / np.outer(scale, scale)
    inverse = np.linalg.pinv(H, rcond=1e-7, hermitian=True) / np.outer(scale, scale)
    return np.asarray(inverse @ (X.T @ e)), np.asarray(inverse)


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


def _size(values: Sequence[FloatArray]) -> float:
    return float(np.quantile(np.abs(np.concatenate(values)), 0.98)) or 1.0


def _candidates(scene: _Scene) -> Iterator[_Candidate]:
    """Yield the dictionary: shapes of single signals, products of two, and time."""
    for place, group in scene.signals.items():
        unit = scene.unit[place]
        for name, values in group.items():
            size = _size(values)
            for text, power, shape in _SHAPES if name != "direction of the command" else _SHAPES[:1]:
                column = scene.shown(place, [shape(s / size) for s in values])
                yield _Candidate(place=place, text=text.format(name), unit=unit, factor=size**-power, column=column)
        for (a, x), (b, z) in itertools.combinations(group.items(), 2):
            if place == "plant":
                size = _size(x) * _size(z)
                column = scene.shown(place, [p * q / size for p, q in zip(x, z, strict=True)])
                yield _Candidate(place=place, text=f"{a} * {b}", unit=unit, factor=1.0 / size, column=column)
        clock = [r.t - r.t[0] for r in scene.data.recordings]
        column = scene.shown(place, [t / _size(clock) for t in clock])
        yield _Candidate(place=place, text="time", unit=unit, factor=1.0 / _size(clock), column=column)


def _equation(scene: _Scene) -> tuple[tuple[Term, ...], Place, float]:
    """Select up to three terms, all added at one place, as long as held-out windows ask for one more."""
    pool = [c for c in _candidates(scene) if scene.is_new(c.column)]
    before = scene.cross_validated(np.zeros((scene.e.size, 0)))
    least = max(LEAST_SHARE * (before - scene.rows), LEAST_DECREASE)
    chosen: list[_Candidate] = []
    error = before
    groups = [[c for c in pool if c.place == place] for place in scene.signals]
    for size in range(1, MOST_TERMS + 1):
        found, i = min((scene.best_subset([c.column for c in group], size), i) for i, group in enumerate(groups))
        if error - found[0] < least:
            break
        error, chosen = found[0], [groups[i][k] for k in found[1]]
    if not chosen:
        return (), "plant", 0.0
    alone = [scene.best_subset([c.column], 1)[0] for c in chosen]
    chosen = [chosen[i] for i in np.argsort(alone)]
    X = np.column_stack([scene.J, *(c.column for c in chosen)])
    beta, inverse = _ridge(X, scene.e, np.zeros((X.shape[1], X.shape[1])))
    left = scene.e - X @ beta
    spread = np.sqrt(np.diag(inverse) * max(1.0, float(left @ left) / max(scene.rows - X.shape[1], 1)))
    first = scene.J.shape[1]
    terms = tuple(
        Term(text=c.text, value=float(beta[first + i] * c.factor), sd=float(spread[first + i] * c.factor), unit=c.unit)
        for i, c in enumerate(chosen)
    )
    return terms, chosen[0].place, scene.explained(error, before)


def _curves(scene: _Scene) -> Iterator[Curve]:
    """Yield a smoothing spline over every signal."""
    before = scene.cross_validated(np.zeros((scene.e.size, 0)))
    second = np.diff(np.eye(SEGMENTS + 3), 2, axis=0)
    for place, group in scene.signals.items():
        for name, values in group.items():
            if name == "direction of the command":
                continue
            low, high = np.quantile(np.concatenate(values), [0.005, 0.995])
            knots = low + (high - low) / SEGMENTS * np.arange(-3, SEGMENTS + 4)

            def spline(s: FloatArray, knots: FloatArray = knots, low: float = low, high: float = high) -> FloatArray:
                inside = np.clip(s, low, high - 1e-9 * (high - low))
                return np.asarray(BSpline.design_matrix(inside, knots, 3).toarray())

            rows = [spline(s) for s in values]
            X = np.column_stack([scene.shown(place, [B[:, k] for B in rows]) for k in range(SEGMENTS + 3)])
            weight = float(np.sum(X**2)) / X.shape[1]
            penalties = [weight * (s * second.T @ second + LEVEL * np.eye(X.shape[1])) for s in SMOOTHINGS]
            error, best = min((scene.cross_validated(X, P), i) for i, P in enumerate(penalties))
            penalty = np.zeros((scene.J.shape[1] + X.shape[1],) * 2)
            penalty[scene.J.shape[1] :, scene.J.shape[1] :] = penalties[best]
            beta, inverse = _ridge(np.column_stack([scene.J, X]), scene.e, penalty)
            x = np.linspace(low, high, 61)
            B = spline(x)
            B = B - B.mean(axis=0)
            first = scene.J.shape[1]
            sd = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", B, inverse[first:, first:], B), 0.0))
            excess = np.sqrt(max(1.0, error / scene.rows))
            yield Curve(
                signal=name, unit=scene.unit[place], place=place, x=x, value=B @ beta[first:], sd=excess * sd,
                explained=scene.explained(error, before),
            )  # fmt: skip
