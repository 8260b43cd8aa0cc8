"""The linear chain alone under many inputs at once, from rest: one pass through the rows for all of them."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from autotune.arrays import FloatArray
from autotune.diagnosis.simulation.chain import Chain
from autotune.diagnosis.simulation.kernel import NODES, OUTPUT
from autotune.diagnosis.simulation.transitions import transition_table


def first_command(chain: Chain, t: FloatArray, row: int) -> int:
    """Return the row whose command is in force at a row's time, dead time counted; the first one where none is yet."""
    now = t[row] + 1e-6 * (t[-1] - t[0]) / (t.size - 1)
    return max(int(np.searchsorted(t + chain.delay_s, now, side="right")) - 1, 0)


def responses(chain: Chain, t: FloatArray, inputs: FloatArray, rows: tuple[int, int, int], step_s: float) -> FloatArray:
    """Return the chain's output at a window's rows for many inputs, from rest.

    Parameters
    ----------
    chain : Chain
        The input enters where its first column of ``B`` does.
    t : (N,) array
        Time stamps of the recording [s].
    inputs : (last - base, K) array
        Deviations from the operating point, held from row to row.
    rows : (base, first, last)
        The row of the first input, see :func:`first_command`, and the window's first row and the row after its last.
    step_s : float
        Sample time, for which transitions are tabulated [s].

    Returns
    -------
    (last - first, K) array
        Deviations of the output: column by column what :meth:`Simulator.run` returns for the chain alone.
    """
    table = transition_table(chain.A, chain.B, step_s)
    numbers = (float(chain.gains[3]), step_s, chain.delay_s)
    return np.asarray(_responses(t, inputs, rows, table, chain.taps[OUTPUT], numbers))


@njit(cache=True, nogil=True)
def _responses(
    t: FloatArray,
    inputs: FloatArray,
    rows: tuple[int, int, int],
    table: FloatArray,
    tap: FloatArray,
    numbers: tuple[float, float, float],
) -> FloatArray:
    (base, first, last), (direct, step, delay) = rows, numbers
    n, many = tap.size, inputs.shape[1]
    out = np.empty((last - first, many))
    x, y = np.zeros((n, many)), np.empty((n, many))
    M, known = np.empty((n, n + 1)), -1.0
    j = base
    for k in range(first, last):
        held = inputs[j - base]
        for c in range(many):
            out[k - first, c] = direct * held[c]
        for i in range(n):
            if tap[i] != 0.0:
                for c in range(many):
                    out[k - first, c] += tap[i] * x[i, c]
        now = t[k]
        while k + 1 < last and now < t[k + 1] - 1e-9 * step:
            while j + 1 < last and t[j + 1] + delay <= now + 1e-6 * step:
                j += 1
            until = t[k + 1]
            if j + 1 < last and now < t[j + 1] + delay < until:
                until = t[j + 1] + delay
            pieces = max(1, math.ceil((until - now) / step - 1e-6))
            node = min((until - now) / pieces * NODES / step, float(NODES))
            if abs(node - known) > 1e-8:
                known = node
                low = int(node + 1e-6)
                part = max(node - low, 0.0)
                high = min(low + 1, NODES)
                M[:] = table[low, :, : n + 1] + part * (table[high, :, : n + 1] - table[low, :, : n + 1])
            held = inputs[j - base]
            for _ in range(pieces):
                for row in range(n):
                    for c in range(many):
                        y[row, c] = M[row, n] * held[c]
                    for i in range(n):
                        for c in range(many):
                            y[row, c] += M[row, i] * x[i, c]
                x, y = y, x
            now = until
    return out
