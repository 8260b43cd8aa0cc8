"""The nominal chain of a model file: free runs, refit, forecast; what the strength of an effect is measured with.

Any chain of blocks num/den with delays. The command is held between rows; readings are taken before their row's command
acts. Misfits are those of free runs over windows of two horizons, the state at each window's start free, as in
:mod:`sim.conceal.retune`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.signal import tf2ss

from sim.conceal.physics import Floats
from sim.conceal.retune import Steps, free_runs

#: Every number of the chain is refitted within this factor of the nominal one.
WITHIN = 5.0
#: Sizes of singular values below which start states of a window are not told apart.
RANK = 1e-9
#: Most evaluations of a refit.
MOST_TRIES = 25
#: Shortest horizon [rows]; longest one, in time constants and as a share of a recording.
LEAST_ROWS, TIME_CONSTANTS, SHARE = 20, 4.0, 0.125


@dataclass(frozen=True, kw_only=True)
class Block:
    """One block: polynomials in descending powers of s, and a delay [s]."""

    num: tuple[float, ...]
    den: tuple[float, ...]
    delay: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Chain:
    """Blocks in series between the offsets of command and reading."""

    blocks: tuple[Block, ...]
    u_offset: float
    y_offset: float

    @property
    def poles(self) -> Floats:
        """Poles of all blocks, shape (n,), complex."""
        return np.concatenate([np.zeros(0), *(np.roots(b.den) for b in self.blocks)])

    @property
    def integrates(self) -> bool:
        """Whether a constant command moves the output for ever."""
        return bool(np.any(np.abs(self.poles) < 1e-9))

    @property
    def slowest_s(self) -> float:
        """Longest time constant of a pole that decays [s]; 0 of a chain without one."""
        rates = np.abs(np.real(self.poles))
        rates = rates[rates > 1e-9]
        return float(1.0 / np.min(rates)) if len(rates) else 0.0


def state_space(blocks: Sequence[Block]) -> tuple[Floats, Floats, Floats, float]:
    """Matrices (A, b, c, d) of the blocks in series, shapes (n, n), (n,), (n,)."""
    A, b, c, d = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
    for block in blocks:
        den = np.trim_zeros(block.den, "f")
        A2, b2, c2, d2 = (np.asarray(part) for part in tf2ss(block.num, den))
        n, m = len(b), len(den) - 1
        joined = np.zeros((n + m, n + m))
        joined[:n, :n], joined[n:, n:] = A, A2[:m, :m]
        joined[n:, :n] = np.outer(b2[:m, 0], c)
        through = float(d2[0, 0])
        A, b, c = joined, np.concatenate([b, b2[:m, 0] * d]), np.concatenate([through * c, c2[0, :m]])
        d = through * d
    return A, b, c, d


def discretise(chain: Chain, Ts: float) -> Steps:
    """Return the exact step of the chain over one sample time with the command's switch inside it.

    Parameters
    ----------
    chain : Chain
        Blocks in a row.
    Ts : float
        Sample time [s].
    """
    A, b, c, d = state_space(chain.blocks)
    n = len(b)
    delay = sum(block.delay for block in chain.blocks)
    rows = int(delay / Ts + 1e-9)
    part = max(delay - rows * Ts, 0.0)
    M = np.zeros((n + 1, n + 1))
    M[:n, :n], M[:n, n] = A, b
    first, second = expm(M * part), expm(M * (Ts - part))
    return Steps(
        A=second[:n, :n] @ first[:n, :n],
        b_before=second[:n, :n] @ first[:n, n],
        b_after=second[:n, n],
        c=c,
        d=d,
        rows=rows,
    )


def start_states(steps: Steps, length: int) -> Floats:
    """Return what each state at a window's start adds to its readings, scaled.

    Parameters
    ----------
    steps : Steps
        The chain's, n states.
    length : int
        Rows of a window.

    Returns
    -------
    (length, n) array
        The contributions.
    """
    rows = np.empty((length, len(steps.c)))
    row = steps.c.copy()
    for k in range(length):
        rows[k] = row
        row = row @ steps.A
    scale = np.max(np.abs(rows), axis=0, initial=0.0)
    return np.asarray(rows / np.where(scale > 0.0, scale, 1.0), dtype=np.float64)


def residuals(chain: Chain, u: Floats, y: Floats, Ts: float, window: int) -> Floats:
    """Return residuals of free runs over whole windows, each window's starting state fitted.

    Parameters
    ----------
    chain : Chain
        Blocks in a row.
    u, y : (N,) array
        Command and reading.
    Ts : float
        Sample time [s].
    window : int
        Rows of a window.
    """
    steps = discretise(chain, Ts)
    count = len(y) // window
    e = y[: count * window].reshape(count, window) - chain.y_offset
    e = e - free_runs(steps, u - chain.u_offset, 0, count, window)
    U, s, _ = np.linalg.svd(start_states(steps, window), full_matrices=False)
    U = U[:, s > RANK * np.max(s, initial=1e-300)]
    return np.asarray((e - (e @ U) @ U.T).ravel(), dtype=np.float64)


def numbers(chain: Chain) -> int:
    """How many numbers of a chain are refitted: gain, coefficients of denominators, delay, one offset."""
    return 2 + sum(_free(b).size for b in chain.blocks) + int(any(b.delay > 0.0 for b in chain.blocks))


def _free(block: Block) -> np.ndarray:
    """Return which coefficients of the denominator are free: all but one of those that are not zero."""
    return np.flatnonzero(block.den)[1:]


def moved(chain: Chain, at: Floats) -> Chain:
    """Return the chain with its numbers moved.

    Parameters
    ----------
    chain : Chain
        Where it begins.
    at : (P,) array
        Logarithms of factors, then one offset as it is added.
    """
    values, blocks = iter(at), []
    gain = math.exp(next(values))
    for block in chain.blocks:
        den = np.array(block.den)
        for i in _free(block):
            den[i] *= math.exp(next(values))
        blocks.append(replace(block, den=tuple(den)))
    blocks[0] = replace(blocks[0], num=tuple(gain * np.array(blocks[0].num)))
    if any(b.delay > 0.0 for b in blocks):
        factor = math.exp(next(values))
        blocks = [replace(b, delay=factor * b.delay) for b in blocks]
    chain = replace(chain, blocks=tuple(blocks))
    if chain.integrates:  # its output offset is a start state
        return replace(chain, u_offset=chain.u_offset + next(values))
    return replace(chain, y_offset=chain.y_offset + next(values))


def retune(
    chain: Chain, records: Sequence[tuple[Floats, Floats]], Ts: float, window: int, start: Floats | None = None
) -> tuple[Floats, float]:
    """Refit the chain's numbers to recordings.

    Parameters
    ----------
    chain
        Nominal chain.
    records
        Command and reading of each, shape (N,).
    Ts, window
        Sample time [s] and rows of a window.
    start
        Numbers from which the refit begins, as they are returned; the nominal ones by default.

    Returns
    -------
    numbers, rms
        For :func:`moved`, and the rms of the residuals with the degrees of freedom of the start states given back.
    """
    u, y = records[0]
    spread = 10.0 * float(np.std(u if chain.integrates else y)) or 1.0
    bound = np.full(numbers(chain), math.log(WITHIN))
    bound[-1] = spread

    def residual(at: Floats) -> Floats:
        with np.errstate(all="ignore"):
            e = np.concatenate([residuals(moved(chain, at), u, y, Ts, window) for u, y in records])
        return np.asarray(np.nan_to_num(np.clip(e, -1e9, 1e9), nan=1e9), dtype=np.float64)

    begin = np.zeros(len(bound)) if start is None else np.clip(start, -0.999 * bound, 0.999 * bound)
    found = least_squares(
        residual, begin, bounds=(-bound, bound), x_scale=bound, max_nfev=MOST_TRIES, ftol=1e-7, xtol=1e-7
    )
    n = len(discretise(chain, Ts).c)
    fitted: Floats = found.x
    return fitted, float(np.sqrt(np.mean(found.fun**2) * window / max(window - n, 1)))


def forecast_error(chain: Chain, u: Floats, y: Floats, Ts: float, horizon: int) -> Floats:
    """Return errors of forecasts, each from the state fitted to the two horizons before it.

    Parameters
    ----------
    chain : Chain
        Blocks in a row.
    u, y : (N,) array
        Command and reading.
    Ts : float
        Sample time [s].
    horizon : int
        Rows of a forecast.
    """
    steps = discretise(chain, Ts)
    rows = start_states(steps, 3 * horizon)
    fit = np.linalg.pinv(rows[: 2 * horizon], rcond=RANK)
    errors = []
    for begin in range(0, len(y) - 2 * horizon, horizon):
        length = min(3 * horizon, len(y) - begin)
        run = free_runs(steps, u - chain.u_offset, begin, 1, length)[0]
        e = y[begin : begin + length] - chain.y_offset - run
        errors.append((e - rows[:length] @ (fit @ e[: 2 * horizon]))[2 * horizon :])
    return np.concatenate(errors)


def horizon_rows(chain: Chain, Ts: float, shortest: int, shortest_kept_back: int) -> int:
    """Return the rows of a forecast: a few time constants, and a share of the shortest recording at most.

    Parameters
    ----------
    chain : Chain
        Has the time constants.
    Ts : float
        Sample time [s].
    shortest, shortest_kept_back : int
        Rows of the shortest recording of each kind.
    """
    wanted = TIME_CONSTANTS * chain.slowest_s / Ts if chain.slowest_s > 0.0 else math.inf
    most = min(SHARE * shortest, 2.0 * SHARE * shortest_kept_back)
    return max(LEAST_ROWS, int(min(wanted, most)))
