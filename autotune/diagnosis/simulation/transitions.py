"""Transition matrices of a linear chain for every step that a simulation may take."""

from __future__ import annotations

import numpy as np
from numba import njit

from autotune.arrays import FloatArray
from autotune.diagnosis.simulation.kernel import NODES


@njit(cache=True, nogil=True)
def transition_table(A: FloatArray, B: FloatArray, step: float, nodes: int = NODES) -> FloatArray:
    """Return exp(A i d) and its integrals times B for i = 0..nodes, d = step/nodes, shape (nodes+1, n, n+INPUTS)."""
    n = A.shape[0]
    m = n + B.shape[1]
    scaled = np.zeros((m, m))
    scaled[:n, :n] = A * (step / nodes)
    scaled[:n, n:] = B * (step / nodes)
    # at least the least norm that states in any sizes give it (Perron's root of |A|), and the same in all of them
    rates = np.abs(scaled[:n, :n])
    for _ in range(3):
        rates = rates @ rates
    norm = np.trace(rates) ** 0.125
    halvings = 0
    while norm > 0.25:
        norm *= 0.5
        halvings += 1
    scaled /= 2.0**halvings
    term = np.eye(m)
    one = np.eye(m)
    for k in range(1, 9):
        term = term @ scaled / k
        one += term
    for _ in range(halvings):
        one = one @ one
    table = np.zeros((nodes + 1, n, m))
    power = np.eye(m)
    for i in range(nodes + 1):
        table[i] = power[:n]
        power = power @ one
    return table
