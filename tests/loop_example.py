"""The numerical example of Pouliquen et al. 2011 (section IV), and a loop with two inputs and two outputs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_discrete_lyapunov
from scipy.signal import lfilter
from scipy.stats import chi2

from autotune.arrays import ComplexArray, FloatArray
from autotune.identification.closed_loop.state_space import InnovationModel, from_polynomials

PLANT_NUM = 1e-3 * np.array([0.0, 0.98, 12.99, 18.59, 3.3, -0.02])
PLANT_DEN = np.array([1.0, -4.4, 8.09, -7.83, 4.0, -0.86])
NOISE_NUM = np.array([1.0, -2.1, 1.45, -0.315, -0.0146, 0.0034])
CONTROLLER_NUM = np.array([0.63, -2.083, 2.8222, -1.865, 0.4978])
CONTROLLER_DEN = np.array([1.0, -2.65, 3.11, -1.75, 0.39])
ROWS = 1229  # j + p + f - 1 with j = 1200 and p = f = 15
BURN_IN = 2000
VARIANCE = 1.0 / 9.0

PLANT = from_polynomials(PLANT_NUM, PLANT_DEN, NOISE_NUM, variance=VARIANCE)
CONTROLLER = from_polynomials(CONTROLLER_NUM, CONTROLLER_DEN)


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopData:
    """r, u and y of one run, (N, channels) each."""

    r: FloatArray
    u: FloatArray
    y: FloatArray


def example_set(seed: int, *, rows: int = ROWS, sd: float = VARIANCE**0.5) -> LoopData:
    """Return one data set of the paper's example: u = r - C y, r white with variance 1."""
    rng = np.random.default_rng(seed)
    r, e = rng.standard_normal((2, rows + BURN_IN)) * np.array([[1.0], [sd]])
    loop_den = np.convolve(PLANT_DEN, CONTROLLER_DEN) + np.convolve(PLANT_NUM, CONTROLLER_NUM)
    y = lfilter(np.convolve(PLANT_NUM, CONTROLLER_DEN), loop_den, r)
    y = y + lfilter(np.convolve(NOISE_NUM, CONTROLLER_DEN), loop_den, e)
    u = lfilter(np.convolve(PLANT_DEN, CONTROLLER_DEN), loop_den, r)
    u = u - lfilter(np.convolve(NOISE_NUM, CONTROLLER_NUM), loop_den, e)
    return LoopData(r=r[BURN_IN:, None], u=u[BURN_IN:, None], y=y[BURN_IN:, None])


def simulate_loop(
    plant: InnovationModel, controller: InnovationModel, r: FloatArray, e: FloatArray, *, burn_in: int = 0
) -> LoopData:
    """Return the loop u = r - C y driven by r (N, n_u) and innovations e (N, n_y), whatever its size."""
    loop = feedback(plant, controller)
    x, x_c = np.zeros(loop.order), np.zeros(controller.order)
    y, u = np.empty((len(r), len(plant.C))), np.empty_like(r)
    for t in range(len(r)):
        y[t] = loop.C @ x + loop.D @ r[t] + np.linalg.solve(np.eye(len(plant.C)) + plant.D @ controller.D, e[t])
        u[t] = r[t] - controller.C @ x_c - controller.D @ y[t]
        x = loop.A @ x + loop.B @ r[t] + loop.K @ e[t]
        x_c = controller.A @ x_c + controller.B @ y[t]
    return LoopData(r=r[burn_in:], u=u[burn_in:], y=y[burn_in:])


def two_by_two() -> tuple[InnovationModel, InnovationModel]:
    """Return a coupled plant of order 4, one pole an integrator, and a diagonal PI that stabilises it."""
    A = np.array([[1.0, 0.1, 0.0, 0.0], [0.0, 0.7, 0.0, 0.05], [0.0, 0.0, 0.8, 0.3], [0.05, 0.0, -0.3, 0.6]])
    B = np.array([[0.05, 0.0], [0.2, 0.02], [0.0, 0.2], [0.05, 0.3]])
    C = np.array([[1.0, 0.0, 0.2, 0.0], [0.0, 0.3, 1.0, 0.0]])
    K = np.array([[0.3, 0.05], [0.1, 0.0], [0.0, 0.4], [0.1, 0.1]])
    plant = InnovationModel(A=A, B=B, C=C, D=np.zeros((2, 2)), K=K, innovation_covariance=0.01 * np.eye(2))
    gain, rate = np.diag([0.6, 0.3]), np.diag([0.03, 0.03])
    controller = InnovationModel(
        A=np.eye(2), B=np.eye(2), C=rate, D=gain, K=np.zeros((2, 2)), innovation_covariance=np.zeros((2, 2))
    )
    return plant, controller


def feedback(plant: InnovationModel, controller: InnovationModel) -> InnovationModel:
    """Return the loop u = r - C y of equation (3), from r to y, with states (x, x_c).

    Parameters
    ----------
    plant, controller : InnovationModel
        G with n_u inputs and n_y outputs, C with n_y inputs and n_u outputs, same sample time.

    Returns
    -------
    InnovationModel
        G (1 + C G)^-1 with its noise; A holds the closed-loop poles.
    """
    plant, controller = plant.with_delay_as_states(), controller.with_delay_as_states()
    B, C, D, Dc = plant.B, plant.C, plant.D, controller.D
    loop = np.eye(D.shape[0]) + D @ Dc
    M = np.linalg.inv(loop)
    # y = M (C x + D C_c x_c + D r + e), with x_c driven by -y as in (3): C_c x_c of the plain C(q) has the other sign
    Cy, Dr = np.asarray(M @ np.hstack([C, -D @ controller.C]), dtype=np.float64), M @ D
    Cu, Du, De = np.hstack([np.zeros((B.shape[1], C.shape[1])), -controller.C]) - Dc @ Cy, np.eye(B.shape[1]), -Dc @ M
    n, n_c = plant.order, controller.order
    A = np.block([[plant.A, np.zeros((n, n_c))], [np.zeros((n_c, n + n_c))]])
    A[:n] += B @ Cu
    A[n:, n:] += controller.A
    A[n:] += controller.B @ Cy
    return InnovationModel(
        A=A,
        B=np.vstack([B @ (Du - Dc @ Dr), controller.B @ Dr]),
        C=Cy,
        D=Dr,
        K=np.vstack([plant.K + B @ De, controller.B @ M]),
        innovation_covariance=plant.innovation_covariance,
        sample_time_s=plant.sample_time_s,
    )


def h2_norm(model: InnovationModel) -> float:
    """Return the H2 norm of the deterministic part, sqrt(sum of squared Markov parameters)."""
    gramian = solve_discrete_lyapunov(model.A, model.B @ model.B.T)
    return float(np.sqrt(np.trace(model.C @ gramian @ model.C.T) + np.sum(model.D**2)))


def difference(first: InnovationModel, second: InnovationModel) -> InnovationModel:
    """Return the model whose response is the first's minus the second's (deterministic part).

    Parameters
    ----------
    first, second : InnovationModel
        Of the same inputs, outputs and sample time.
    """
    first, second = first.with_delay_as_states(), second.with_delay_as_states()
    n, k = first.order, second.order
    return replace(
        first,
        A=np.block([[first.A, np.zeros((n, k))], [np.zeros((k, n)), second.A]]),
        B=np.vstack([first.B, second.B]),
        C=np.hstack([first.C, -second.C]),
        D=first.D - second.D,
        K=np.vstack([first.K, second.K]),
    )


def inside_region(error: ComplexArray, covariance: FloatArray, probability: float = 0.95) -> FloatArray:
    """Return whether errors lie in the region of the probability, 1.0 or 0.0, same shape as ``error``.

    Parameters
    ----------
    error : (...) array
        Complex differences between a true value and its estimate.
    covariance : (..., 2, 2) array
        Covariance of (re, im); singular where only one direction varies (a real pole): there the region is an interval.
    probability : float
        Of the region.
    """
    values, vectors = np.linalg.eigh(covariance)
    parts = np.stack([error.real, error.imag], axis=-1)
    turned = np.einsum("...ij,...i->...j", vectors, parts)
    largest = np.maximum(values[..., -1:], np.finfo(np.float64).tiny)
    varies = values > 1e-12 * largest
    distance = np.sum(np.where(varies, turned**2 / np.where(varies, values, 1.0), 0.0), axis=-1)
    quantile = np.where(varies.all(axis=-1), chi2.ppf(probability, 2), chi2.ppf(probability, 1))
    return np.asarray(distance <= quantile, dtype=np.float64)
