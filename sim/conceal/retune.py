"""How well the nominal structure does once its numbers are refitted: what strength is measured against.

The residuals are those of free runs over windows of two horizons, the state at each window's start free; the forecast
of the unseen recording starts every horizon from the state fitted to the two horizons before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from sim.conceal.physics import Floats


@dataclass(frozen=True, kw_only=True)
class Chain:
    """Linear chain: gain, lags, delay and offsets of a rig's nominal structure."""

    integrating: bool
    K: float
    tau_actuator: float
    tau_plant: float
    tau_sensor: float
    delay: float
    u_offset: float
    y_offset: float


@dataclass(frozen=True, kw_only=True)
class Steps:
    """Chain over one sample time; the command switches ``rows`` sample times and a part of one late."""

    A: Floats
    b_before: Floats
    b_after: Floats
    c: Floats
    d: float = 0.0
    rows: int


def discretise(chain: Chain, Ts: float) -> Steps:
    """Return the exact step of the chain over one sample time with the command's switch inside it.

    Parameters
    ----------
    chain : Chain
        The nominal form.
    Ts : float
        Sample time [s].
    """
    lags = [(chain.tau_actuator, 1.0), (chain.tau_plant, chain.K)]
    if chain.integrating:
        lags.append((np.inf, 1.0))
    if chain.tau_sensor > 0.0:
        lags.append((chain.tau_sensor, 1.0))
    n = len(lags)
    A, b = np.zeros((n, n)), np.zeros(n)
    for i, (tau, gain) in enumerate(lags):
        rate = 0.0 if tau == np.inf else 1.0 / tau
        A[i, i] = -rate
        entry = gain if tau == np.inf else gain * rate
        if i == 0:
            b[0] = entry
        else:
            A[i, i - 1] = entry
    rows = int(chain.delay // Ts)
    part = chain.delay - rows * Ts
    M = np.zeros((n + 1, n + 1))
    M[:n, :n], M[:n, n] = A, b
    first, second = _exponential(M * part), _exponential(M * (Ts - part))
    c = np.zeros(n)
    c[-1] = 1.0
    return Steps(
        A=second[:n, :n] @ first[:n, :n], b_before=second[:n, :n] @ first[:n, n], b_after=second[:n, n], c=c, rows=rows
    )


@njit(cache=True)
def _exponential(M: Floats) -> Floats:
    """Matrix exponential of a small matrix: Taylor series of M / 2^k, squared k times."""
    n = len(M)
    size = 0.0
    for i in range(n):
        size = max(size, np.sum(np.abs(M[i])))
    k = 0
    while size > 0.125:
        size, k = size / 2.0, k + 1
    X = M / 2.0**k
    total, term = np.eye(n) + X, X.copy()
    for i in range(2, 11):
        term = term @ X / i
        total += term
    for _ in range(k):
        total = total @ total
    return total


@njit(cache=True)
def _runs(
    A: Floats, before: Floats, after: Floats, c: Floats, d: float, u: Floats, rows: int, begin: int, out: Floats
) -> None:
    """Fill ``out``, shape (windows, length), with free runs from zero state, window after window from ``begin``."""
    n = len(c)
    x, z = np.zeros(n), np.zeros(n)
    count, length = out.shape
    for w in range(count):
        x[:] = 0.0
        for i in range(length):
            k = begin + w * length + i - rows
            old, new = u[max(k - 1, 0)], u[max(k, 0)]
            y = d * old
            for a in range(n):
                y += c[a] * x[a]
                z[a] = before[a] * old + after[a] * new
                for b in range(n):
                    z[a] += A[a, b] * x[b]
            out[w, i] = y
            x, z = z, x


def free_runs(steps: Steps, u: Floats, begin: int, count: int, length: int) -> Floats:
    """Return free runs from zero state, one after the other.

    Parameters
    ----------
    steps : Steps
        The chain's, n states.
    u : (N,) array
        Command about zero.
    begin : int
        First row.
    count, length : int
        Runs, and rows of each.

    Returns
    -------
    (count, length) array
        Outputs about their offset.
    """
    out = np.zeros((count, length))
    _runs(steps.A, steps.b_before, steps.b_after, steps.c, steps.d, u, steps.rows, begin, out)
    return out


@njit(cache=True)
def _observability(A: Floats, c: Floats, length: int) -> Floats:
    """Rows c A^k, shape (length, n)."""
    n = len(c)
    out = np.empty((length, n))
    row, after = c.copy(), np.empty(n)
    for k in range(length):
        for j in range(n):
            out[k, j] = row[j]
            after[j] = 0.0
            for i in range(n):
                after[j] += row[i] * A[i, j]
        row, after = after, row
    return out


def residuals(chain: Chain, u: Floats, y: Floats, Ts: float, window: int) -> Floats:
    """Residuals of free runs over whole windows, each window's starting state fitted.

    Parameters
    ----------
    chain : Chain
        The nominal form.
    u, y : (N,) array
        Command and reading.
    Ts : float
        Sample time [s].
    window : int
        Rows of a window.
    """
    steps = discretise(chain, Ts)
    count = len(y) // window
    runs = free_runs(steps, u - chain.u_offset, 0, count, window)
    e = y[: count * window].reshape(count, window) - chain.y_offset - runs
    q, _ = np.linalg.qr(_observability(steps.A, steps.c, window))
    out: Floats = (e - (e @ q) @ q.T).ravel()
    return out


def _degrees_lost(chain: Chain, window: int) -> float:
    """Factor that makes the rms residual of white noise its standard deviation."""
    n = 2 + int(chain.integrating) + int(chain.tau_sensor > 0.0)
    return float(np.sqrt(window / (window - n)))


def _move_numbers(nominal: Chain, d: Floats) -> Chain:
    """Nominal chain with its numbers moved: logarithms of factors, one offset last but for the delay."""
    K, ta, tp = nominal.K * np.exp(d[0]), nominal.tau_actuator * np.exp(d[1]), nominal.tau_plant * np.exp(d[2])
    if nominal.integrating:  # its output offset is the integrator's state
        return replace(nominal, K=K, tau_actuator=ta, tau_plant=tp, u_offset=nominal.u_offset + d[3])
    y_offset, delay = nominal.y_offset + d[3], nominal.delay * np.exp(d[4])
    return replace(nominal, K=K, tau_actuator=ta, tau_plant=tp, y_offset=y_offset, delay=delay)


def retune(
    nominal: Chain, records: list[tuple[Floats, Floats]], Ts: float, window: int, tolerance: float = 1e-6
) -> tuple[Chain, float]:
    """Refit gain, lags, delay (each within a factor of two) and one offset by damped, projected Gauss-Newton.

    Returns the refitted chain and its rms residual.

    Parameters
    ----------
    nominal : Chain
        Where it begins.
    records : list of ((N,) array, (N,) array)
        u and y of each recording.
    Ts : float
        Sample time [s].
    window : int
        Rows of a window.
    tolerance : float
        Relative decrease of the sum of squares below which it ends.
    """
    count = 4 if nominal.integrating else 5
    bound = np.full(5, np.log(2.0))
    bound[3] = 10.0 * float(np.std(records[0][0 if nominal.integrating else 1]))

    def residual(d: Floats) -> Floats:
        return np.concatenate([residuals(_move_numbers(nominal, d), u, y, Ts, window) for u, y in records])

    at, damping = np.zeros(5), 1e-3
    e = residual(at)
    for _ in range(25):
        J = np.empty((len(e), count))
        for i in range(count):
            d = at.copy()
            d[i] += 1e-4 * bound[i]
            J[:, i] = (residual(d) - e) / (d[i] - at[i])
        H, g = J.T @ J, J.T @ e
        gain = 0.0
        # a number at its bound stays there; one that the records do not feel, as with a command that never moves, too
        held = ((abs(at[:count]) >= bound[:count]) & (at[:count] * g < 0.0)) | (np.diag(H) == 0.0)
        for _ in range(6):
            M = H + damping * np.diag(np.diag(H))
            M[held, :], M[:, held] = 0.0, 0.0
            M[held, held] = 1.0
            step = np.zeros(5)
            step[:count] = -np.linalg.solve(M, np.where(held, 0.0, g))
            trial = np.clip(at + step, -bound, bound)
            e_trial = residual(trial)
            if e_trial @ e_trial < e @ e:
                gain = 1.0 - float(e_trial @ e_trial) / float(e @ e)
                at, e, damping = trial, e_trial, damping / 5.0
                break
            damping *= 8.0
        if gain < tolerance:
            break
    chain = _move_numbers(nominal, at)
    return chain, float(np.sqrt(np.mean(e**2)) * _degrees_lost(nominal, window))


def forecast_error(chain: Chain, u: Floats, y: Floats, Ts: float, horizon: int) -> Floats:
    """Errors of forecasts over one horizon each, started from the state fitted to the two horizons before.

    Parameters
    ----------
    chain : Chain
        The nominal form.
    u, y : (N,) array
        Command and reading.
    Ts : float
        Sample time [s].
    horizon : int
        Rows of a forecast.
    """
    steps = discretise(chain, Ts)
    rows = _observability(steps.A, steps.c, 3 * horizon)
    fit = np.linalg.pinv(rows[: 2 * horizon])
    errors = []
    du = u - chain.u_offset
    for begin in range(0, len(y) - 2 * horizon, horizon):
        length = min(3 * horizon, len(y) - begin)
        run = free_runs(steps, du, begin, 1, length)[0]
        e = y[begin : begin + length] - chain.y_offset - run
        errors.append((e - rows[:length] @ (fit @ e[: 2 * horizon]))[2 * horizon :])
    return np.concatenate(errors)
