"""The numerical example of Pouliquen et al. 2011 (section IV), and a loop with two inputs and two outputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from autotune.arrays import FloatArray
from autotune.identification.closed_loop.state_space import InnovationModel, feedback, from_polynomials

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
