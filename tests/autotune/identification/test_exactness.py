"""Data without noise give the plant to 1e-8, whatever the identifier, the plant and the operating point."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st
from scipy.signal import cont2discrete, lfilter

import autotune as at
from autotune.identification.closed_loop.methods import METHODS, Method

#: what fails is told as it was found
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)
EXACT = 1e-8
DT = 0.1


def held_record(a: tuple[float, ...], b: float, delay_s: float, level: tuple[float, float], seed: int) -> at.Recording:
    """A plant at rest about (u, y) whose held command is a random binary sequence; exact at the rows."""
    rng = np.random.default_rng(seed)
    n, rows = len(a), 2000
    t = np.arange(rows) * DT
    u = np.repeat(rng.choice([-1.0, 1.0], rows // 8), 8)
    companion = np.eye(n, k=1)
    companion[-1] = a
    x, whole = np.zeros(n), int(delay_s / DT)
    part = delay_s - whole * DT
    late = np.concatenate([np.zeros(whole + 1), u])[: rows + 1]  # late[k] acts until t_k + part
    y = np.empty(rows)
    steps = [
        cont2discrete((companion, b * np.eye(n)[:, -1:], np.eye(n), np.zeros((n, 1))), width)[:2]
        for width in (max(part, 1e-300), DT - part)
    ]
    for k in range(rows):
        y[k] = x[0]
        for (F, G), value in zip(steps, (late[k], late[k + 1]), strict=True):
            x = F @ x + G[:, 0] * value
    return at.Recording(t=t, u=u + level[0], y=y + level[1], name="held")


@settings(max_examples=8, phases=PHASES, deadline=None)
@given(
    method=st.sampled_from(["output-error", "algebraic", "online"]),
    lags=st.tuples(st.floats(0.7, 1.2), st.floats(1.5, 3.0)),
    delay_s=st.floats(0.0, 1.5),
    level=st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0)),
    seed=st.integers(0, 99),
)
@example(  # without delay the sum of squares falls below the rounding of y's own
    method="output-error", lags=(1.1427755609229207, 2.0727863976901806), delay_s=0.0, level=(41.85, -35.61), seed=73
)
def test_delays(method: str, lags: tuple[float, float], delay_s: float, level: tuple[float, float], seed: int) -> None:
    one, two = lags
    a, b = (-1.0 / (one * two), -(one + two) / (one * two)), 1.5 / (one * two)
    found = at.delay(held_record(a, b, delay_s, level, seed), 2, method=method)
    np.testing.assert_allclose(found.values[:4], [*a, b, delay_s], atol=EXACT)


@settings(max_examples=6, phases=PHASES, deadline=None)
@given(a=st.floats(2.0, 3.0), b=st.floats(1.0, 2.0), h1=st.floats(0.3, 2.0), h2=st.floats(0.3, 4.0))
def test_two_delays(a: float, b: float, h1: float, h2: float) -> None:
    """x'' + a x(t - h_1) = b u(t - h_2) for a sum of sines, known to be smooth between rows."""
    t = np.arange(8001) / 100.0
    waves = ((3.0, 0.5, 0.0), (2.0, 1.0 / 3.0, 1.0), (1.0, 0.9, 2.0))

    def x(s: np.ndarray, second: bool = False) -> np.ndarray:
        return sum(A * np.sin(w * s + p) * (-(w**2) if second else 1.0) for A, w, p in waves)

    record = at.Recording(t=t, u=(x(t + h2, second=True) + a * x(t + h2 - h1)) / b, y=x(t), metadata={"hold": "linear"})
    found = at.delay(record, delays=2)
    np.testing.assert_allclose(found.values, [a, b, h1, h2], atol=EXACT)


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=4, phases=PHASES, deadline=None)
@given(
    radius=st.floats(0.5, 0.95),
    angle=st.floats(0.2, 1.0),
    gain=st.floats(0.2, 0.6),
    level=st.tuples(st.floats(-30.0, 30.0), st.floats(-30.0, 30.0)),
    seed=st.integers(0, 99),
)
def test_closed_loops(
    method: Method, radius: float, angle: float, gain: float, level: tuple[float, float], seed: int
) -> None:
    """u = r - C y with an integrating C, about any operating point."""
    a = np.array([1.0, -2.0 * radius * np.cos(angle), radius**2])
    b, d, c = np.array([0.0, 0.1, 0.05]), gain * np.array([0.1, -0.05]), np.array([1.0, -1.0])
    whole = np.convolve(a, c) + np.convolve(b, d)
    if np.max(np.abs(np.roots(whole))) > 0.98:
        return
    r = np.random.default_rng(seed).standard_normal(800)
    y, u = (lfilter(np.convolve(p, c), whole, r) for p in (b, a))
    shifted = (u + level[0], y + level[1])
    record = at.Recording(t=np.arange(800.0), u=shifted[0], y=shifted[1], extra={"r": r}, name="loop")
    found = at.closed_loop(record, 2, method=method)
    model = found.estimate.model if method == "prediction-error" else found
    omega = np.geomspace(0.05, 3.0, 20)
    z = np.exp(-1j * omega)
    true = np.polyval(b[::-1], z) / np.polyval(a[::-1], z)
    np.testing.assert_allclose(model.response(omega)[:, 0, 0], true, atol=EXACT * np.max(np.abs(true)))
