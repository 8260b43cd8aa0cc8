"""What the loop with the new controller is expected to do, as a band: plant uncertainty and noise drawn together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter, tf2ss

from autotune.arrays import FloatArray
from autotune.design.law import PILaw
from autotune.models import TransferFunction


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """Response of the closed loop to given set-points and disturbances, around the operating point.

    Attributes
    ----------
    y : (N,) array
        Expected measurement, of the estimated plant without noise [y unit].
    low, high : (N,) array
        Pointwise band that holds 95 % of normally distributed measurements with the draws' scatter, which is averaged
        over neighbouring samples [y unit].
    u : (N,) array
        Expected command, disturbance not included [u unit].
    y_draws : (D, N) array
        The drawn measurements, noise included [y unit].
    """

    y: FloatArray
    low: FloatArray
    high: FloatArray
    u: FloatArray
    y_draws: FloatArray


def sampled(plant: TransferFunction, sample_time_s: float) -> tuple[FloatArray, FloatArray]:
    """Return num and den of the plant behind a zero-order hold, in ascending powers of the delay operator.

    Parameters
    ----------
    plant : TransferFunction
        Strictly proper; its dead time may be any, also a fraction of the sample time.
    sample_time_s : float
        T_s [s].

    Returns
    -------
    num, den : (M,), (n + 1,) array
        Exact at the samples; den begins with 1.
    """
    A, B, C, _ = (np.atleast_2d(matrix) for matrix in tf2ss(plant.num, plant.den))
    n = A.shape[0]
    whole = int(np.floor(plant.delay_s / sample_time_s + 1e-9))
    late = max(0.0, plant.delay_s - whole * sample_time_s)

    def step(duration: float) -> tuple[FloatArray, FloatArray]:
        augmented = np.zeros((n + 1, n + 1))
        augmented[:n, :n], augmented[:n, n:] = A, B
        exponential = expm(augmented * duration)
        return exponential[:n, :n], exponential[:n, n:]

    transition, _ = step(sample_time_s)
    after, new = step(sample_time_s - late)  # the newer command acts for the rest of the period
    _, old = step(late)
    old = after @ old
    den = np.real(np.poly(transition))
    num = np.zeros(n + 2 + whole)
    for gain, delay in ((new, whole), (old, whole + 1)):
        markov = [0.0] + [float((C @ np.linalg.matrix_power(transition, k) @ gain)[0, 0]) for k in range(n)]
        num[delay : delay + n + 1] += np.convolve(den, markov)[: n + 1]
    return num, den


def predict(
    plant: TransferFunction,
    draws: Sequence[TransferFunction],
    law: PILaw,
    setpoint: FloatArray,
    disturbance: FloatArray,
    noise_sd: float,
    rng: np.random.Generator,
) -> Prediction:
    """Predict the loop around its operating point, away from the limits of u.

    Parameters
    ----------
    plant : TransferFunction
        Estimate of the plant.
    draws : sequence of TransferFunction
        Plants drawn from the estimate's uncertainty; one noise sequence is drawn for each.
    law : PILaw
        The law as it will run.
    setpoint, disturbance : (N,) array
        Departure of r from the operating point [y unit]; what is added to the command [u unit].
    noise_sd : float
        Standard deviation of the white measurement noise [y unit].
    rng : Generator
        Source of the noise.

    Notes
    -----
    The loop runs on noise alone for N samples before the first one counts, so that the band holds the wander that the
    noise itself causes. Limits and quantisation of u are not in it.
    """
    y, u = _respond(plant, law, setpoint, disturbance, np.zeros_like(setpoint))
    count = setpoint.size
    quiet = np.zeros(count)
    y_draws = np.empty((len(draws), count))
    for i, drawn in enumerate(draws):
        noise = noise_sd * rng.standard_normal(2 * count)
        true, _ = _respond(drawn, law, np.concatenate([quiet, setpoint]), np.concatenate([quiet, disturbance]), noise)
        y_draws[i] = (true + noise)[count:]
    scatter = np.sqrt(uniform_filter1d(np.mean((y_draws - y) ** 2, axis=0), max(1, count // 60), mode="nearest"))
    return Prediction(y=y, low=y - 1.96 * scatter, high=y + 1.96 * scatter, u=u, y_draws=y_draws)


def _respond(
    plant: TransferFunction, law: PILaw, setpoint: FloatArray, disturbance: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the plant's output and the law's command: u = C_r r - C (y + n), y = P (u + d)."""
    B_p, A_p = sampled(plant, law.sample_time_s)
    discrete = law.discrete()
    B_c, A_c = np.array(discrete.num), np.array(discrete.den)
    c = law.controller
    integral = c.K * law.sample_time_s / c.Ti_s  # zero for an infinite T_I
    B_r = np.array([c.K * c.setpoint_weight + integral, -c.K * c.setpoint_weight])
    closed = np.convolve(A_p, A_c)
    loop = np.convolve(B_p, B_c)
    closed = np.pad(closed, (0, max(0, loop.size - closed.size)))
    closed[: loop.size] += loop
    filtered = np.convolve(_without_integrator(A_c), B_r) if integral else A_c * c.K * c.setpoint_weight
    y = (
        lfilter(np.convolve(B_p, filtered), closed, setpoint)
        + lfilter(np.convolve(B_p, A_c), closed, disturbance)
        - lfilter(np.convolve(B_p, B_c), closed, noise)
    )
    u = (
        lfilter(np.convolve(A_p, filtered), closed, setpoint)
        - lfilter(np.convolve(B_p, B_c), closed, disturbance)
        - lfilter(np.convolve(A_p, B_c), closed, noise)
    )
    return np.asarray(y, dtype=np.float64), np.asarray(u, dtype=np.float64)


def _without_integrator(A_c: FloatArray) -> FloatArray:
    """Divide 1 - q^-1 out of the law's denominator."""
    return np.cumsum(A_c)[:-1]
