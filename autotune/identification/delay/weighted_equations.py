"""Modulated equations weighted by what noise on y makes of them: errors in variables, without bias and with intervals.

The equations of the modulating functions are linear in y, which stands in the regressors: least squares on them is
biased towards zero by noise (Table 1 of Ollivier et al.). For parameters theta noise w on y adds G(theta) w, so that

    min over theta of e(theta)^T V(theta)^-1 e(theta),    V = G G^T,

asks for the smallest noise that makes all equations hold: consistent, and efficient among estimates from these
windows. Its gradient takes the regressors freed of the noise so found, w = G^T V^-1 e. The starting value needs no
weights: with the noise's covariance N in the regressors known up to its size, the smallest generalised eigenvalue of
their products is that size (Koopmans 1937, Levin 1964).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import LinAlgError

from autotune.arrays import ComplexArray, FloatArray
from autotune.identification.delay.modulated_integrals import interpolate, running_fourier

#: (1 - cos 2 pi s)^2 as a sum of exponentials: three derivatives vanish at its ends.
_WINDOW = ((-2, 0.25), (-1, -1.0), (0, 1.5), (1, -1.0), (2, 0.25))
#: Combinations of equations that hold less than this share of the noise of the largest repeat others.
_OWN = 1e-6
#: Steps, and the last one's size in standard deviations or, without noise, as a share of the values.
_ROUNDS, _SETTLED, _ROUNDING = 30, 1e-5, 1e-11


class Equations(Protocol):
    """Equations e(theta) = 0 that are linear in y, and what noise on y adds to them."""

    def left(self, values: FloatArray) -> FloatArray:
        """Return e, (equations,)."""

    def of_noise(self, values: FloatArray) -> FloatArray:
        """Return G, (equations, samples), for noise samples of variance 1."""

    def steps(self, values: FloatArray) -> FloatArray:
        """Return steps of the parameters for difference quotients."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Weighted:
    """Minimum of the weighted equations.

    Attributes
    ----------
    values : (P,) array
        Parameters.
    cost : float
        e^T V^-1 e, in noise samples' variances.
    freedom : int
        Independent equations less parameters.
    jacobian : (equations kept, P) array
        Whitened, of the equations freed of noise.
    settled : bool
        Whether the last step was small beside the standard deviations.
    """

    values: FloatArray
    cost: float
    freedom: int
    jacobian: FloatArray
    settled: bool

    @property
    def variance(self) -> float:
        """Variance of the noise samples."""
        return self.cost / max(self.freedom, 1)

    @property
    def condition(self) -> float:
        """Condition of the equations, each parameter in its own unit."""
        return float(np.linalg.cond(self.jacobian / np.maximum(np.linalg.norm(self.jacobian, axis=0), 1e-300)))

    @property
    def covariance(self) -> FloatArray:
        """Of the parameters; infinite where the equations do not determine them."""
        size = np.linalg.norm(self.jacobian, axis=0)
        if not np.all(size > 0.0):
            return np.full((size.size,) * 2, np.inf)
        inverse = np.linalg.pinv(self.jacobian / size, rcond=1e-10)
        return np.asarray(self.variance * (inverse @ inverse.T) / np.outer(size, size), dtype=np.float64)


def minimise_weighted(equations: Equations, start: FloatArray) -> Weighted:
    """Return the minimum of the weighted equations in whose valley a start lies.

    Parameters
    ----------
    equations : Equations
        With the derivatives' steps.
    start : (P,) array
        Values of the unknowns.

    Raises
    ------
    LinAlgError
        Equations that noise on y does not enter.
    """
    values = np.asarray(start, dtype=np.float64)
    here = _evaluate(equations, values)
    settled = False
    for _ in range(_ROUNDS):
        size = np.maximum(np.linalg.norm(here.jacobian, axis=0), np.finfo(np.float64).tiny)
        step = -np.linalg.lstsq(here.jacobian / size, here.whitened, rcond=1e-10)[0] / size
        far = float(np.linalg.norm(here.jacobian @ step)) / max(np.sqrt(here.cost / max(here.freedom, 1)), 1e-300)
        for _halving in range(8):
            trial = _evaluate(equations, values + step)
            if trial.cost <= here.cost or far < 1e-2:
                break
            step, far = 0.5 * step, 0.5 * far
        else:
            break
        values, here = values + step, trial
        settled = far < _SETTLED or bool(np.all(np.abs(step) <= _ROUNDING * np.abs(values)))
        if settled:
            break
    return Weighted(
        values=values, cost=here.cost, freedom=here.freedom - values.size, jacobian=here.jacobian, settled=settled
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Evaluated:
    cost: float
    whitened: FloatArray
    jacobian: FloatArray
    freedom: int


def _evaluate(equations: Equations, values: FloatArray) -> _Evaluated:
    """Return the whitened equations and their derivatives, those of the output that noise is taken off."""
    e, G = equations.left(values), equations.of_noise(values)
    scale = np.linalg.norm(G, axis=1)
    if not (np.all(np.isfinite(e)) and np.all(np.isfinite(scale)) and np.all(scale > 0.0)):
        raise LinAlgError("equations without noise")
    sizes, vectors = np.linalg.eigh((G / scale[:, None]) @ (G / scale[:, None]).T)
    kept = sizes > _OWN * sizes[-1]
    whiten = (vectors[:, kept] / np.sqrt(sizes[kept])).T / scale
    left = whiten @ e
    noise = (whiten @ G).T @ left
    steps = equations.steps(values)
    columns = []
    for i, step in enumerate(steps):
        moved = values.copy()
        moved[i] += step
        columns.append(((equations.left(moved) - e) - (equations.of_noise(moved) - G) @ noise) / step)
    jacobian = whiten @ np.column_stack(columns)
    return _Evaluated(cost=float(left @ left), whitened=left, jacobian=jacobian, freedom=int(kept.sum()))


class Windows:
    """Windows (1 - cos)^2 (1, cos q, sin q, ..) of 2 pi (t - T)/L, q up to some harmonic, over intervals of one length.

    Parameters
    ----------
    starts : (S,) array
        T of every interval [s].
    length_s : float
        L [s].
    harmonics : int
        Largest q.
    """

    def __init__(self, starts: FloatArray, length_s: float, harmonics: int) -> None:
        self.starts, self.length_s, self.harmonics = starts, length_s, harmonics
        self._omega = 2.0 * np.pi / length_s * np.arange(harmonics + 3)

    def __len__(self) -> int:
        return self.starts.size * (2 * self.harmonics + 1)

    def running(self, t: FloatArray, values: FloatArray, held: bool) -> list[ComplexArray]:
        """Return the running integrals of a signal that :meth:`of_signal` takes.

        Parameters
        ----------
        t, values : (N,) array
            Time stamps [s] and the signal.
        held : bool
            Whether it is held between rows (else linear).
        """
        return [running_fourier(t, values, float(omega), held) for omega in self._omega]

    def of_signal(self, t: FloatArray, running: list[ComplexArray], shift_s: float, derivative: int) -> FloatArray:
        """Return the integrals of v(t - shift) against the windows' derivative, (windows,).

        Parameters
        ----------
        t : (N,) array
            Time stamps [s].
        running : list of (N,) complex array
            As of :meth:`running`.
        shift_s : float
            How late the signal acts [s].
        derivative : int
            Order of the windows' derivative.
        """
        first = self.starts - shift_s
        parts = []
        for omega, sums in zip(self._omega, running, strict=True):
            part = interpolate(t, sums, first + self.length_s) - interpolate(t, sums, first)
            parts.append(part * np.exp(-1j * omega * first))
        return self._combine(parts, derivative)

    def on(self, t: FloatArray, shift_s: float, derivative: int) -> FloatArray:
        """Return the windows' derivative at every t + shift, (windows, times).

        Parameters
        ----------
        t : (N,) array
            Times [s].
        shift_s : float
            Added to them [s].
        derivative : int
            Order of the windows' derivative.
        """
        s = t + shift_s - self.starts[:, None]
        inside = (s > 0.0) & (s < self.length_s)
        return self._combine([np.where(inside, np.exp(1j * omega * s), 0.0) for omega in self._omega], derivative)

    @property
    def areas(self) -> FloatArray:
        """Return the windows' integrals, (windows,)."""
        none = np.zeros(self.starts.size, dtype=np.complex128)
        return self._combine([none + self.length_s, *[none] * (self.harmonics + 2)], 0)

    def _combine(self, waves: list[ComplexArray], derivative: int) -> FloatArray:
        """Return the windows, harmonic by harmonic, from the exponentials of non-negative frequencies."""
        rows = []
        for q in range(self.harmonics + 1):
            total = np.zeros(waves[0].shape, dtype=np.complex128)
            for k, weight in _WINDOW:
                omega = self._omega[abs(q + k)]
                wave, turn = (waves[q + k], 1j * omega) if q + k >= 0 else (np.conj(waves[-q - k]), -1j * omega)
                total += weight * turn**derivative * wave
            rows += [total.real] if q == 0 else [total.real, total.imag]
        return np.concatenate(rows)
