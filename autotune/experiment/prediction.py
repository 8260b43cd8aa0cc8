"""What the loop with the new controller is expected to do, as a band: plant uncertainty and noise drawn together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.linalg import expm
from scipy.ndimage import uniform_filter1d

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
    n = len(plant.den) - 1
    A, B = np.eye(n, k=-1), np.eye(n, 1)
    A[0] = -np.array(plant.den[1:]) / plant.den[0]
    C = np.array([(0.0,) * (n - len(plant.num)) + plant.num]) / plant.den[0]
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
    *,
    u_rest: float,
    thin: int = 1,
) -> Prediction:
    """Predict the loop around its operating point, the limits of the command and of its rate included.

    Parameters
    ----------
    plant : TransferFunction
        Estimate of the plant.
    draws : sequence of TransferFunction
        Plants drawn from the estimate's uncertainty; one noise sequence is drawn for each.
    law : PILaw
        The law as it will run; its limits hold for its command and the disturbance together.
    setpoint, disturbance : (N,) array
        Departure of r from the operating point [y unit]; what is added to the command [u unit].
    noise_sd : float
        Standard deviation of the white measurement noise [y unit].
    rng : Generator
        Source of the noise.
    u_rest : float
        Command that holds the operating point [u unit], which the limits are counted from.
    thin : int
        Samples of the law between two rows, of a device whose own law runs faster than it is looked at.

    Notes
    -----
    The loop runs on noise alone for N samples before the first one counts, so that the band holds the wander that the
    noise itself causes. Quantisation of u is not in it.
    """
    setpoint, disturbance = np.repeat(setpoint, thin), np.repeat(disturbance, thin)
    count = setpoint.size
    quiet = np.zeros(count)
    y, u = _respond(plant, law, setpoint, disturbance, quiet, u_rest)
    whole_setpoint, whole_disturbance = np.concatenate([quiet, setpoint]), np.concatenate([quiet, disturbance])
    y_draws = np.empty((len(draws), count // thin))
    for i, drawn in enumerate(draws):
        noise = noise_sd * rng.standard_normal(2 * count)
        true, _ = _respond(drawn, law, whole_setpoint, whole_disturbance, noise, u_rest)
        y_draws[i] = (true + noise)[count::thin]
    y, u, count = y[::thin], u[::thin], count // thin
    scatter = np.sqrt(uniform_filter1d(np.mean((y_draws - y) ** 2, axis=0), max(1, count // 60), mode="nearest"))
    return Prediction(y=y, low=y - 1.96 * scatter, high=y + 1.96 * scatter, u=u, y_draws=y_draws)


def _respond(
    plant: TransferFunction,
    law: PILaw,
    setpoint: FloatArray,
    disturbance: FloatArray,
    noise: FloatArray,
    u_rest: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the plant's output and the law's command, both from rest."""
    num, den = sampled(plant, law.sample_time_s)
    c, T_s = law.controller, law.sample_time_s
    # an infinite T_I gives no integral
    terms = (c.K, c.setpoint_weight, c.K * T_s / c.Ti_s, T_s / (c.Tf_s + T_s), c.K * c.Td_s / T_s, law.tracking_gain)
    low, high = law.u_min - u_rest - disturbance, law.u_max - u_rest - disturbance
    y, u = _step_loop(num, den, terms, low, high, law.u_rate * T_s, setpoint, disturbance, noise)
    return y, u


@njit(cache=True)
def respond_sampled(num: FloatArray, den: FloatArray, u: FloatArray) -> FloatArray:
    """Return the output (N,) of a difference equation from rest, as :func:`sampled` gives it, to commands (N,).

    Parameters
    ----------
    num, den : (M,) and (K,) arrays
        Coefficients of powers of the delay of one row, the constant first.
    u : (N,) array
        Input.
    """
    y = np.zeros(u.size)
    for k in range(u.size):
        y[k] = _next_output(num, den, u, y, k)
    return y


@njit(cache=True)
def _next_output(num: FloatArray, den: FloatArray, u: FloatArray, y: FloatArray, k: int) -> float:
    """Return y of row k from the rows before it."""
    total = 0.0
    for i in range(1, min(num.size, k + 1)):
        total += num[i] * u[k - i]
    for i in range(1, min(den.size, k + 1)):
        total -= den[i] * y[k - i]
    return total


@njit(cache=True)
def _step_loop(
    num: FloatArray,
    den: FloatArray,
    terms: tuple[float, float, float, float, float, float],
    low: FloatArray,
    high: FloatArray,
    move: float,
    setpoint: FloatArray,
    disturbance: FloatArray,
    noise: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Step the law, as :meth:`PILaw.step` does, on the plant's difference equation."""
    K, weight, slope, blend, lead, tracking = terms
    count = setpoint.size
    y, u, into = np.zeros(count), np.zeros(count), np.zeros(count)
    y_filtered = integral = command = reached = 0.0
    for k in range(count):
        y[k] = _next_output(num, den, into, y, k)
        moved = blend * (y[k] + noise[k] - y_filtered)
        y_filtered += moved
        integral += slope * (setpoint[k] - y_filtered)
        wanted = K * (weight * setpoint[k] - y_filtered) + integral - lead * moved
        command = min(max(wanted, command - move), command + move)
        command = min(max(command, low[k]), high[k])
        integral += tracking * (command - wanted)
        # the load too comes no faster than the command may move
        reached = min(max(command + disturbance[k], reached - move), reached + move)
        u[k], into[k] = command, reached
    return y, u
