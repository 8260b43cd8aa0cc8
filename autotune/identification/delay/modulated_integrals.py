"""Integrals of a recording against shifted windows: what the equations of the modulating functions are made of.

A power of the sine is shifted by what is still missing of the delay within the family of its own sines and cosines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numba import njit

from autotune.arrays import ComplexArray, FloatArray
from autotune.identification.delay.modulating import SinePower
from autotune.recording import Recording

Interval: TypeAlias = tuple[float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Modulated:
    """Integrals over all intervals.

    Attributes
    ----------
    output : (intervals, n + 1) array
        (-1)^i L^-i I_{y, f^(i)}, i = 0..n.
    of_input : callable
        From h to the (intervals, columns) integrals of u(t - h) against the family of the window's shifts.
    whole : (columns,) array
        Weights of these columns that give the window itself.
    step : callable
        From the family's coefficients and b's sign to what the delay still lacks, in shares of an interval.
    """

    output: FloatArray
    of_input: Callable[[float], FloatArray]
    whole: FloatArray
    step: Callable[[FloatArray, float], float]


def modulated_by_fourier_sums(recording: Recording, order: int, intervals: Sequence[Interval]) -> Modulated:
    """Return the integrals for the lowest even power of the sine that serves an order.

    f is a sum of cosines, so each integral is a difference of int v(t) exp(j omega t) dt at the interval's ends,
    turned by its beginning: a step of the iteration costs nothing per row.

    Parameters
    ----------
    recording : Recording
        u and y over t, linear between rows.
    order : int
        Order n of the equation.
    intervals : sequence of (float, float)
        Begin and end of each [s], in the recording's time, all of one length.
    """
    terms = SinePower(m=order + order % 2).fourier()
    t = recording.t - recording.t[0]
    starts, ends = np.array(intervals, dtype=np.float64).T - recording.t[0]
    L = float(ends[0] - starts[0])

    def integrals(values: FloatArray) -> Callable[[float], ComplexArray]:
        sums = [running_fourier(t, values, omega / L, False) for _, omega in terms]

        def at(h: float) -> ComplexArray:
            first, last = starts - h, ends - h
            parts = [interpolate(t, running, last) - interpolate(t, running, first) for running in sums]
            return np.column_stack(
                [part * np.exp(-1j * omega / L * first) for part, (_, omega) in zip(parts, terms, strict=True)]
            )

        return at

    y = integrals(recording.y)(0.0)
    of_u = integrals(recording.u)
    Y = np.zeros((starts.size, order + 1))
    for i in range(order + 1):
        for q, (c, omega) in enumerate(terms):
            Y[:, i] += (-1.0) ** i * L**-i * np.real(c * (1j * omega) ** i * y[:, q])

    def of_input(h: float) -> FloatArray:
        u = of_u(h)
        columns = []
        for q, (c, omega) in enumerate(terms):
            part = c * u[:, q]
            columns += [part.real] if omega == 0.0 else [part.real, -part.imag]
        return np.column_stack(columns)

    def step(b: FloatArray, sign: float) -> float:
        # b cos(omega (s + d)) = b_c cos(omega s) - b_s sin(omega s): d = arctan(b_s / b_c) / omega
        return float(np.arctan2(sign * b[2], sign * b[1]) / terms[1][1])

    whole = [1.0] + [1.0, 0.0] * (len(terms) - 1)
    return Modulated(output=Y, of_input=of_input, whole=np.array(whole), step=step)


@njit(cache=True)
def running_fourier(t: FloatArray, values: FloatArray, omega: float, held: bool) -> ComplexArray:
    """Return int v(s) exp(j omega s) ds from t[0] to every row.

    Parameters
    ----------
    t : (N,) array
        Time stamps [s], N at least 2.
    values : (N,) array
        The signal v.
    omega : float
        Angular frequency [rad/s].
    held : bool
        Whether v is held between rows (else linear).

    Returns
    -------
    (N,) complex array
        Integrals [v unit s].
    """
    result = np.zeros(t.size, dtype=np.complex128)
    re = 0.0
    im = 0.0
    first_step = t[1] - t[0]
    shift = 0.5 * first_step if held else 0.0  # a held value acts at the middle of its step, on average
    turn_re = np.cos(omega * first_step)
    turn_im = np.sin(omega * first_step)
    c = np.cos(omega * (t[0] + shift))
    s = np.sin(omega * (t[0] + shift))
    for k in range(1, t.size):
        step = t[k] - t[k - 1]
        last_c = c
        last_s = s
        if k % 64 and abs(step - first_step) < 1e-9 * first_step:  # turning the phase on is cheaper than a new sine
            c = last_c * turn_re - last_s * turn_im
            s = last_s * turn_re + last_c * turn_im
        elif held:
            last_c = np.cos(omega * (t[k - 1] + 0.5 * step))
            last_s = np.sin(omega * (t[k - 1] + 0.5 * step))
            c = np.cos(omega * (t[k] + 0.5 * first_step))
            s = np.sin(omega * (t[k] + 0.5 * first_step))
        else:
            c = np.cos(omega * t[k])
            s = np.sin(omega * t[k])
        if held:
            re += step * values[k - 1] * last_c
            im += step * values[k - 1] * last_s
        else:
            re += 0.5 * step * (values[k - 1] * last_c + values[k] * c)
            im += 0.5 * step * (values[k - 1] * last_s + values[k] * s)
        result[k] = re + 1j * im
    return result


def interpolate(t: FloatArray, running: ComplexArray, at: FloatArray) -> ComplexArray:
    """Return a running integral at any times, linear between its rows.

    Parameters
    ----------
    t : (N,) array
        Time stamps [s].
    running : (N,) complex array
        The integral up to each.
    at : (M,) array
        The times asked for [s].

    Returns
    -------
    (M,) complex array
        The integral up to these.
    """
    row = np.minimum(np.maximum(np.searchsorted(t, at) - 1, 0), t.size - 2)
    share = (at - t[row]) / (t[row + 1] - t[row])
    return np.asarray(running[row] + share * (running[row + 1] - running[row]), dtype=np.complex128)
