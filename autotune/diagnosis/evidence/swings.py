"""Score tests against signals that swing: a chain sees the waves of all frequencies in one pass through the rows."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial, reduce

import numpy as np
from numba import njit

from autotune.arrays import BoolArray, FloatArray
from autotune.diagnosis.evidence.residual import NEW, FreedResidual
from autotune.diagnosis.simulation.many_inputs import first_command, responses
from autotune.models import Place

#: Numbers of one window's waves that are held in memory at once.
AT_ONCE = 2_000_000
#: Parts of the windows that are summed side by side.
PARTS = 16
#: Squared sine of the angle between what cos and sin show up to which they are one.
ALIKE = 1e-10


@dataclass(frozen=True, kw_only=True, eq=False)
class Swinging:
    """What is multiplied by waves.

    Attributes
    ----------
    place : str
        Where it enters the chain.
    signals : sequence of (N,) array
        Per recording.
    """

    place: Place
    signals: Sequence[FloatArray]


def explained_by_swings(left: FreedResidual, e: FloatArray, swinging: Sequence[Swinging], count: int) -> FloatArray:
    """Return how much of a residual each signal explains when it swings.

    Parameters
    ----------
    left : FreedResidual
        The fit whose residual it is.
    e : (N,) array
        The whitened residual, freed of start states and of the model's own numbers.
    swinging : sequence of Swinging
        Signals that are multiplied by cos and sin of every recording's own time.
    count : int
        Highest frequency, in cycles per length of the longest recording.

    Returns
    -------
    (signals, count + 1) array
        Decrease of the sum of e^2 by cos and sin together, at 0 to ``count`` cycles, as far as free numbers cannot
        imitate them.

    Notes
    -----
    Per frequency the two columns' products with each other, with the residual and with an orthonormal basis of what
    the numbers explain are summed over windows: no column is ever held whole.
    """
    data, basis = left.data, np.column_stack([left.own, e])
    places = [(i, w) for i, starts in enumerate(data.starts) for w in range(len(starts))]
    windows = list(zip(places, left.result.windows, left.result.states_explain, strict=True))
    per_cycle = 2.0 * np.pi / max(r.duration_s for r in data.recordings)
    rows = max(last - first for first, last in left.result.windows)
    pieces = min(count + 1, -(-rows * 2 * (count + 1) // AT_ONCE))

    def summed(part: int, frequencies: FloatArray) -> list[_Products]:
        found = (
            _window(left, swinging, place, basis[first:last], Q, frequencies)
            for place, (first, last), Q in windows[part::PARTS]
        )
        return reduce(_added, found)

    decreases = []
    with ThreadPoolExecutor(2) as pool:
        for cycles in np.array_split(np.arange(count + 1.0), pieces):
            one = partial(summed, frequencies=per_cycle * cycles)
            parts = pool.map(one, range(min(PARTS, len(windows))))
            decreases.append(np.array([products.decrease for products in reduce(_added, parts)]))
    return np.concatenate(decreases, axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Products:
    """What one signal's waves have in common with others, rows summed: K cosines, then K sines.

    Attributes
    ----------
    own : (p + 1, 2 K) array
        With the directions of the model's own numbers, and in the last row with the residual.
    each : (2 K,) array
        With themselves.
    between : (K,) array
        Cosine with sine of the same frequency.
    """

    own: FloatArray
    each: FloatArray
    between: FloatArray

    @property
    def decrease(self) -> FloatArray:
        """Decrease of the residual's sum of squares by cosine and sine, the numbers' directions taken out, (K,)."""
        many = self.between.size
        own, e = self.own[:-1], self.own[-1]
        left = self.each - np.sum(own**2, axis=0)
        is_new = left > NEW * self.each
        scale = np.where(is_new, 1.0 / np.sqrt(np.where(is_new, left, 1.0)), 0.0)
        cos, sin = e[:many] * scale[:many], e[many:] * scale[many:]
        both = self.between - np.sum(own[:, :many] * own[:, many:], axis=0)
        rho = both * scale[:many] * scale[many:]
        apart = 1.0 - rho**2
        joint = (cos**2 + sin**2 - 2.0 * rho * cos * sin) / np.maximum(apart, ALIKE)
        return np.asarray(np.where(apart > ALIKE, joint, np.maximum(cos**2, sin**2)))


def _added(a: Sequence[_Products], b: Sequence[_Products]) -> list[_Products]:
    return [
        _Products(own=x.own + y.own, each=x.each + y.each, between=x.between + y.between)
        for x, y in zip(a, b, strict=True)
    ]


def _window(
    left: FreedResidual,
    swinging: Sequence[Swinging],
    place: tuple[int, int],
    basis: FloatArray,
    Q: FloatArray,
    frequencies: FloatArray,
) -> list[_Products]:
    """Return the products of every signal's waves in one window, given by its recording and its number there."""
    data, (i, w) = left.data, place
    t, many = data.recordings[i].t, frequencies.size
    first, last = int(data.starts[i][w]), int(data.stops[i][w])
    chains = {place: left.chain(place) for place in ("actuator", "plant")}
    begins = {place: first_command(chain, t, first) for place, chain in chains.items()}
    waves = _waves(t[min(first, *begins.values()) : last] - t[0], frequencies)
    ar, found = np.array(data.noise.ar), []
    for one in swinging:
        begin = begins.get(one.place, first)
        X = one.signals[i][begin:last, None] * waves[waves.shape[0] - (last - begin) :]
        if one.place in chains:
            X = responses(chains[one.place], t, X, (begin, first, last), data.sample_times[i])
        _whiten(X, data.good[i][first:last], ar, data.noise.sd)
        X -= Q @ (Q.T @ X)
        found.append(
            _Products(
                own=basis.T @ X,
                each=np.einsum("ij,ij->j", X, X),
                between=np.einsum("ij,ij->j", X[:, :many], X[:, many:]),
            )
        )
    return found


def _waves(t: FloatArray, frequencies: FloatArray) -> FloatArray:
    """Return cosines, then sines, at times [s] of angular frequencies [rad/s] that are evenly spaced, (N, 2 K)."""
    step = frequencies[1] - frequencies[0] if frequencies.size > 1 else 0.0
    return np.asarray(_turned(t, float(frequencies[0]), float(step), frequencies.size))


@njit(cache=True, nogil=True)
def _turned(t: FloatArray, lowest: float, step: float, many: int) -> FloatArray:
    out = np.empty((t.size, 2 * many))
    for k in range(t.size):
        c, s = np.cos(lowest * t[k]), np.sin(lowest * t[k])
        by_c, by_s = np.cos(step * t[k]), np.sin(step * t[k])
        for i in range(many):
            out[k, i], out[k, many + i] = c, s
            c, s = c * by_c - s * by_s, s * by_c + c * by_s
    return out


@njit(cache=True, nogil=True)
def _whiten(X: FloatArray, good: BoolArray, ar: FloatArray, sd: float) -> None:
    """Whiten columns of one window in place, as :meth:`Data.whitened` does."""
    for k in range(X.shape[0] - 1, -1, -1):
        counts = good[k]
        for lag in range(1, min(k, ar.size) + 1):
            counts = counts and good[k - lag]
        for c in range(X.shape[1]):
            X[k, c] = X[k, c] / sd if counts else 0.0
        if counts:
            for lag in range(1, min(k, ar.size) + 1):
                for c in range(X.shape[1]):
                    X[k, c] -= ar[lag - 1] / sd * X[k - lag, c]
