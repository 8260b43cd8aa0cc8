"""A rough model that carries what is not periodic, so that the Fourier ratio only has to carry its error.

With Y = G U + leakage, the leakage is proportional to G; taking the ratio on e = y - G_ref u leaves only the
leakage of G - G_ref. Any G_ref is admissible (the ratio corrects it); a good one makes the switching jitter, the
transient and the images of the hold second-order small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from autotune.arrays import ComplexArray, FloatArray

#: Step of the logarithms whose differences are derivatives.
_NUDGE = 1e-5


@dataclass(frozen=True, kw_only=True)
class ReferenceModel:
    """K exp(-s L) / ((s + p)(1 + s tau)).

    Attributes
    ----------
    K : float
        Gain factor [y unit/(u unit s)].
    p, tau : float
        Slow pole [rad/s] and lag [s].
    L : float
        Dead time [s].
    """

    K: float
    p: float
    tau: float
    L: float

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return the complex gain at the angular frequencies."""
        s = 1j * np.asarray(omega_rad_s, dtype=np.float64)
        return np.asarray(self.K * np.exp(-s * self.L) / ((s + self.p) * (1.0 + s * self.tau)), dtype=np.complex128)


def _errors(
    thetas: FloatArray, prior: FloatArray, limit: FloatArray, omega: FloatArray, G: ComplexArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return weighted errors and penalties at rows theta = log (p, tau, L), (k, 2H + 3), with each row's best K, (k,).

    The penalties are weak around the start, so that what the points leave open stays finite, and steep above the
    limits: a dead time of many periods fits the phase at a few points and nothing between them.
    """
    p, tau, L = np.exp(thetas.T)[:, :, None]
    s = 1j * omega
    shape = weight * np.exp(-s * L) / ((s + p) * (1.0 + s * tau))
    K = np.sum((shape.conj() * (weight * G)).real, axis=1) / np.sum(np.abs(shape) ** 2, axis=1)
    error = K[:, None] * shape - weight * G
    penalties = (thetas - prior) / 6.0 + 10.0 * np.maximum(thetas - limit, 0.0)
    return np.concatenate([error.real, error.imag, penalties], axis=1), K


def _fit(
    start: FloatArray, limit: FloatArray, omega: FloatArray, G: ComplexArray, weight: FloatArray
) -> tuple[FloatArray, float, float]:
    """Levenberg-Marquardt on the three logarithms; not compiled, which would take longer than all its fits."""

    def at(theta: FloatArray) -> tuple[FloatArray, float, float]:
        errors, K = _errors(theta[None], start, limit, omega, G, weight)
        return errors[0], float(K[0]), float(errors[0] @ errors[0])

    theta, damping, moved = start.copy(), 1e-2, True
    error, K, cost = at(theta)
    for _ in range(60):
        if moved:
            beside = _errors(theta + _NUDGE * np.eye(3), start, limit, omega, G, weight)[0]
            jacobian = (beside - error).T / _NUDGE
            normal, gradient = jacobian.T @ jacobian, jacobian.T @ error
        trial = theta - np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
        trial_error, trial_K, trial_cost = at(trial)
        moved = trial_cost < cost
        if moved:
            done = cost - trial_cost < 1e-10 * cost
            theta, error, K, cost = trial, trial_error, trial_K, trial_cost
            damping = max(damping * 0.2, 1e-9)
            if done:
                break
        else:
            damping *= 5.0
            if damping > 1e9:
                break
    return theta, K, cost


def fit_reference(
    omega_rad_s: FloatArray, G: ComplexArray, sd: FloatArray, excitation: FloatArray, *, integrating: bool = False
) -> ReferenceModel:
    """Fit the rough model to a few frequency points, so that what it leaves of y is small.

    Parameters
    ----------
    omega_rad_s : (H,) array
        Frequencies [rad/s], the fundamental first.
    G : (H,) complex array
        Estimates there.
    sd : (H,) array
        Their standard deviations.
    excitation : (H,) array
        Amplitude of u at each: the errors that count are those of y. 1 % of the fundamental's amplitude in y is
        added to the standard deviations, since the model is rough.
    integrating : bool
        Keep the slow pole far below the frequencies.
    """
    allowed = 0.01 * float(np.abs(G[0]) * excitation[0])
    weight = excitation / np.hypot(sd * excitation, allowed)
    low, middle = float(omega_rad_s[0]), float(np.exp(np.mean(np.log(omega_rad_s))))
    limit = np.log([100.0 * omega_rad_s[-1], 5.0 / low, 3.0 / low])
    starts = [np.log([p * w, tau / w, L / w]) for w, p, tau, L in ((low, 0.1, 0.3, 0.1), (middle, 0.5, 0.3, 0.3))]
    if integrating:
        limit[0] = math.log(1e-3 * low)
        for start in starts:
            start[0] = limit[0]
    fits = [_fit(start, limit, omega_rad_s, G, weight) for start in starts]
    theta, K, _ = min(fits, key=lambda fit: fit[2])
    return ReferenceModel(K=float(K), p=math.exp(theta[0]), tau=math.exp(theta[1]), L=math.exp(theta[2]))


@njit(cache=True)
def _simulate(t: FloatArray, u: FloatArray, K: float, p: float, tau: float, L: float) -> FloatArray:
    """Step the two first-order links exactly from one change of the delayed command to the next."""
    n = t.size
    y = np.empty(n)
    x1, x2 = 0.0, 0.0
    j = -1  # the command in force at the plant is u[j], delayed by L; before the first it is zero
    now = t[0]
    q = 1.0 / tau
    for k in range(n):
        while now < t[k]:
            target = t[k]
            if j + 1 < n and t[j + 1] + L < target:
                target = t[j + 1] + L
            h = target - now
            if h > 0.0:
                v = u[j] if j >= 0 else 0.0
                e1, e2 = np.exp(-p * h), np.exp(-q * h)
                forced = K * v / p
                mixed = q * (e1 - e2) / (q - p) if abs(q - p) > 1e-6 * q else q * h * e2
                x2 = e2 * x2 + mixed * (x1 - forced) + (1.0 - e2) * forced
                x1 = e1 * (x1 - forced) + forced
                now = target
            if j + 1 < n and t[j + 1] + L <= now:
                j += 1
        y[k] = x2
    return y


def simulate_reference(t: FloatArray, u: FloatArray, model: ReferenceModel) -> FloatArray:
    """Return the rough model's output at the stamps, at rest at the first, driven by the held command.

    Parameters
    ----------
    t, u : (N,) array
        Stamps [s] and held command, as departure from its mean.
    model : ReferenceModel
        The rough model.
    """
    return np.asarray(_simulate(t, u, model.K, model.p, model.tau, model.L), dtype=np.float64)


def free_responses(t: FloatArray, model: ReferenceModel) -> tuple[FloatArray, ...]:
    """Return how the rough model's two states run down from the first stamp on, as columns of unit size.

    A mode that outlasts the window is a parabola beside offset and drift: its pole is moved to where the column still
    differs from those. One that is over within one sample is left out.

    Parameters
    ----------
    t : (N,) array
        Time stamps [s].
    model : ReferenceModel
        The rough model.

    Returns
    -------
    tuple of (N,) array
        Two columns, or fewer.
    """
    span = float(t[-1] - t[0])
    slow, fast = sorted((model.p, 1.0 / model.tau))
    slow = max(slow, 0.5 / span)
    fast = max(fast, 1.001 * slow)
    first = np.exp(-slow * (t - t[0]))
    if fast * span > t.size:
        return (first,) if slow * span < t.size else ()
    second = (first - np.exp(-fast * (t - t[0]))) * (fast / (fast - slow))
    return (first, second)
