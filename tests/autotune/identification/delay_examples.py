"""The examples of Ollivier, Moutaouakil and Sadik (2007), integrated by a solver of somebody else."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from autotune.arrays import FloatArray
from autotune.recording import Recording

A = (-0.35, -1.2)
B = 2.0
X0 = (20.0, 0.3)


def u_example_1(t: FloatArray) -> FloatArray:
    return 60.0 * np.cos(1.23 * t + 1.3 * np.sin(t) - 0.7 * np.cos(0.5 * t))


def u_example_2(t: FloatArray) -> FloatArray:
    return 60.0 * np.cos(1.23 * t + 0.33 * np.sin(t) - 0.47 * np.cos(0.5 * t))


def response(
    u: Callable[[FloatArray], FloatArray],
    t: FloatArray,
    delay: Callable[[float], float],
    a1: Callable[[float], float] = lambda _: A[1],
) -> FloatArray:
    """x and x' of x'' = a1(t) x' + a0 x + b u(t - delay(t)), shape (2, N)."""

    def slope(s: float, x: FloatArray) -> list[float]:
        return [x[1], a1(s) * x[1] + A[0] * x[0] + B * float(u(np.asarray(s - delay(s))))]

    return solve_ivp(slope, (t[0], t[-1]), X0, t_eval=t, rtol=1e-9, atol=1e-9, max_step=0.2).y


def example_2(
    delay_s: float = 4.0, duration_s: float = 105.0, rate_hz: float = 500.0, past_s: float = 0.0
) -> Recording:
    """Example 2 without noise; rows before t = 0 carry the input's past, and y = 0 there."""
    t = np.arange(-round(past_s * rate_hz), round(duration_s * rate_hz) + 1) / rate_hz
    y = np.zeros(t.size)
    y[t >= 0] = response(u_example_2, t[t >= 0], lambda _: delay_s)[0]
    return Recording(t=t, u=u_example_2(t), y=y, metadata={"hold": "linear"}, name="example 2")


def held_response(
    t: FloatArray, u: FloatArray, poles: tuple[complex, ...], gain: float, delay_s: float, substeps: int = 20
) -> FloatArray:
    """Output of gain exp(-s h)/prod(s - p) for held u from rest at u[0], by a fine zero-order-hold simulation."""
    from scipy.signal import cont2discrete, lfilter

    dt = (t[1] - t[0]) / substeps
    fine = np.arange((t.size - 1) * substeps + 1) * dt
    held = np.clip(np.floor((fine - delay_s) / (t[1] - t[0]) + 1e-9).astype(int), 0, None)
    driving = u[held] - u[0]
    num, den, _ = cont2discrete(([gain], np.poly(poles).real), dt, method="zoh")
    return lfilter(num.ravel(), den, driving)[::substeps]
