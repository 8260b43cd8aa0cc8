"""One delay from weighted modulated equations: without the bias that noise gives the paper's least squares.

x^(n) = sum a_i x^(i) + b u(t - h) + d is multiplied by windows and integrated by parts. For every delay of a grid the
smallest generalised eigenvalue is the noise's variance with the best a, b and d; from its lowest minima the weighted
equations are minimised. What quadrature and hold leave in the equations is computed on the model's own response and
taken off, so that exact data give an exact answer; the noise's colour comes from the same residual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, eigh

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import IdentificationError
from autotune.identification.delay.data import DelayData
from autotune.identification.delay.output_error import Structure, residuals, solve_linear
from autotune.identification.delay.output_error_model import colour_of
from autotune.identification.delay.weighted_equations import Weighted, Windows, minimise_weighted
from autotune.identification.noise_colour import NoiseColour
from autotune.one_thread import on_one_thread

#: Largest harmonic of a window, intervals per length, and most intervals, which are then spaced out over the record.
_HARMONICS, _OVERLAP, _MOST = 4, 3, 60
#: Samples of the noise in an interval: nothing in a window is faster than its sixth harmonic.
_SAMPLES = 60
#: Delays of the grid per period of the fastest harmonic, and minima that are followed.
_GRID, _TRIED = 24, 4
#: Rounds of taking off what quadrature leaves, and the change, in standard deviations or as a share, that ends them.
_ROUNDS, _SETTLED, _ROUNDING = 8, 1e-4, 1e-11
#: Fewest rows for a colour of the noise.
_COLOURED_ROWS = 60


@dataclass(frozen=True, kw_only=True, eq=False)
class OneDelay:
    """Equations of (a_0.., b, h, d).

    Attributes
    ----------
    order : int
        Order n.
    windows : Windows
        What they are modulated with.
    t, of_u : (M,) array, list of arrays
        Stamps [s] and running integrals of u.
    of_y : (windows, n + 1) array
        (-1)^i int y f^(i).
    taken_off : (windows,) array
        What quadrature leaves of the model's own response.
    sample_s : float
        Width of the samples of noise [s]: a share of an interval, a row at least.
    noise : (n + 1, windows, samples) array
        What unit samples of noise on y add to ``of_y``.
    """

    order: int
    windows: Windows
    t: FloatArray
    of_u: list[ComplexArray]
    of_y: FloatArray
    taken_off: FloatArray
    sample_s: float
    noise: FloatArray

    @classmethod
    def of(cls, data: DelayData, order: int, windows: Windows) -> OneDelay:
        """Return the equations of a record.

        Parameters
        ----------
        data : DelayData
            The record.
        order : int
            Order n.
        windows : Windows
            What the equations are modulated with.
        """
        width = max(windows.length_s / _SAMPLES, float(data.ty[-1] - data.ty[0]) / (data.ty.size - 1))
        samples = np.arange(windows.starts[0] + 0.5 * width, windows.starts[-1] + windows.length_s, width)
        return cls(
            order=order,
            windows=windows,
            t=data.tu,
            of_u=windows.running(data.tu, data.u, not data.linear),
            of_y=_of_output(data.ty, data.y, order, windows),
            taken_off=np.zeros(len(windows)),
            sample_s=float(width),
            noise=np.stack([(-1.0) ** i * width * windows.on(samples, 0.0, i) for i in range(order + 1)]),
        )

    def left(self, values: FloatArray) -> FloatArray:
        """Return what the equations leave."""
        n = self.order
        u = self.windows.of_signal(self.t, self.of_u, float(values[n + 1]), 0)
        of_x = self.of_y @ np.append(values[:n], -1.0)
        return np.asarray(of_x + values[n] * u + values[n + 2] * self.windows.areas - self.taken_off)

    def of_noise(self, values: FloatArray) -> FloatArray:
        """Return what samples of noise add."""
        return np.asarray(np.tensordot(np.append(values[: self.order], -1.0), self.noise, axes=1))

    def steps(self, values: FloatArray) -> FloatArray:
        """Return the steps of difference quotients: the equations are linear in all but h."""
        steps = np.maximum(np.abs(values), 1e-3)
        steps[self.order + 1] = 1e-6 * self.windows.length_s
        return steps

    def start(self, h: float) -> tuple[float, FloatArray]:
        """Return the noise's variance and the values for a delay, by the smallest generalised eigenvalue."""
        n = self.order
        scale = np.linalg.norm(self.noise[n], axis=1)[:, None]
        known = np.column_stack([self.windows.of_signal(self.t, self.of_u, h, 0), self.windows.areas]) / scale
        of_y, noise = self.of_y / scale, self.noise / scale
        of_known, *_ = np.linalg.lstsq(known, of_y, rcond=None)
        free = of_y - known @ of_known
        spread = np.tensordot(noise, noise, axes=([1, 2], [1, 2])) * (1.0 - 2.0 / len(of_y))
        sizes = np.sqrt(np.diag(spread))
        variances, vectors = eigh(free.T @ free / np.outer(sizes, sizes), spread / np.outer(sizes, sizes))
        a = vectors[:, 0] / sizes
        if a[n] == 0.0:
            return float("inf"), np.zeros(n + 3)
        a = -a / a[n]
        b, d = -of_known @ a
        return float(variances[0]), np.array([*a[:n], b, h, d])


def _of_output(t: FloatArray, y: FloatArray, order: int, windows: Windows) -> FloatArray:
    running = windows.running(t, y, False)
    return np.column_stack([(-1.0) ** i * windows.of_signal(t, running, 0.0, i) for i in range(order + 1)])


@on_one_thread
def weighted_delay(
    data: DelayData, order: int, length_s: float, *, start_s: float | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return (a_0.., b, h, d) of a record by weighted modulated equations.

    Parameters
    ----------
    data : DelayData
        The record about its operating point.
    order : int
        Order n.
    length_s : float
        Length of the intervals [s].
    start_s : float, optional
        A delay that is tried besides those of the grid [s].

    Returns
    -------
    (n + 3,) array, (n + 3, n + 3) array
        Values and covariance; its 1.96 standard deviations are 95 % intervals, the noise's colour being estimated.

    Raises
    ------
    IdentificationError
        The equations do not determine a, b and h.
    """
    largest = max(0.5 * (data.duration_s - length_s), 0.0)
    grid = np.arange(0.0, largest + 1e-12, length_s / (_HARMONICS + 2) / _GRID)
    found: list[tuple[float, FloatArray]] = []
    whole = OneDelay.of(data, order, _windows(data, length_s, largest))
    costs = np.array([whole.start(float(h))[0] for h in grid])
    padded = np.concatenate([[np.inf], costs, [np.inf]])
    minima = np.flatnonzero((costs <= padded[:-2]) & (costs <= padded[2:]))
    starts = [float(grid[i]) for i in minima[np.argsort(costs[minima])][:_TRIED]]
    for h in starts + ([] if start_s is None or start_s > largest else [start_s]):
        tried = _minimum(whole, whole.start(h)[1], largest)
        if tried is not None:
            found.append((tried.variance, tried.values))
    if not found:
        raise _refusal_of_order(data, order)
    values = min(found, key=lambda pair: pair[0])[1]
    return _settle(data, order, length_s, values, largest)


def _minimum(equations: OneDelay, start: FloatArray, largest: float) -> Weighted | None:
    n = equations.order
    try:
        found = minimise_weighted(equations, start)
    except LinAlgError:
        return None
    inside = -0.02 * equations.windows.length_s <= found.values[n + 1] <= largest
    return found if inside and found.freedom > 0 and np.all(np.isfinite(found.values)) else None


def _settle(
    data: DelayData, order: int, length_s: float, values: FloatArray, largest: float
) -> tuple[FloatArray, FloatArray]:
    """Return the estimate with the colour of the noise, and with what quadrature leaves taken off; its covariance."""
    n = order
    h = max(float(values[n + 1]), 0.0)
    usable = data.usable_from(h)
    plain = OneDelay.of(data, order, _windows(data, length_s, min(h + 0.1 * length_s, largest)))
    found: Weighted | None = None
    for coloured in (False, True):
        for _ in range(_ROUNDS):
            simulated, colour = _correct_quadrature(plain, usable, values, coloured=coloured)
            found = _minimum(simulated, values, largest)
            if found is None:
                raise _refusal_of_order(data, order)
            sd = np.sqrt(np.diag(found.covariance))
            moved, values = np.abs(found.values - values), found.values
            if np.all(moved <= np.maximum(_SETTLED * sd, _ROUNDING * np.abs(values))):
                break
    assert found is not None
    if not np.all(np.isfinite(found.covariance)) or not sd[n] < abs(values[n]):
        raise _refusal_of_order(data, order)
    wider = np.ones(n + 3) if colour is None else colour.widening()[: n + 3]
    return values, found.covariance * np.outer(wider, wider)


def _correct_quadrature(
    plain: OneDelay, data: DelayData, values: FloatArray, *, coloured: bool
) -> tuple[OneDelay, NoiseColour | None]:
    """Return the equations less what they leave of the model's own response, and under noise of the residual's colour.

    The colour is that of the residual's means over samples, None where it is not asked for or rows are too few.
    """
    from scipy.signal import lfilter  # here: it takes long to import, and few recordings come this way

    n = plain.order
    structure = Structure(order=n)
    point = solve_linear(data, structure, tuple(values[:n].tolist()), max(float(values[n + 1]), 0.0))
    if not np.isfinite(point.cost):  # an unstable model's response overflows
        return plain, None
    residual = residuals(data, point)
    ideal = replace(plain, of_y=_of_output(data.ty, data.y - residual, n, plain.windows))
    simulated = np.array([*point.a, point.theta[0], point.h, point.theta[1]])
    corrected = replace(plain, taken_off=ideal.left(simulated))
    at = np.floor((data.ty - data.ty[0]) / plain.sample_s).astype(np.int64)
    if not coloured or np.unique(at).size < _COLOURED_ROWS or not np.ptp(residual) > 0.0:
        return corrected, None
    colour = colour_of(data, structure, point, samples=at)
    noise = lfilter([1.0], [1.0, *colour.whitening.ar], corrected.noise[..., ::-1])[..., ::-1]
    return replace(corrected, noise=np.asarray(noise)), colour


def _windows(data: DelayData, length_s: float, reach_s: float) -> Windows:
    """Return windows over the later part of a record, whose input reaches back as far as the delay."""
    first = max(float(data.ty[0]), float(data.tu[0]) + reach_s)
    last = float(data.ty[-1]) - length_s
    count = int(min(max((last - first) / length_s * _OVERLAP, 0.0) + 1.0, _MOST))
    return Windows(np.linspace(first, max(last, first), count), length_s, _HARMONICS)


def _refusal_of_order(data: DelayData, order: int) -> IdentificationError:
    return IdentificationError(
        f"modulated equations do not determine order {order}",
        where=data.name,
        remedy="give intervals several times as long as the delay, another --order, or --method output-error",
    )
