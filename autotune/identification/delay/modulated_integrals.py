"""Integrals of a recording against shifted windows: what the equations of the modulating functions are made of.

Two forms of the window's shift by what is still missing of the delay: for a power of the sine exactly, within the
family of its own sines and cosines; for any window by its Taylor expansion up to order k.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numba import njit

from autotune.arrays import ComplexArray, FloatArray
from autotune.identification.delay.modulating import SinePower, Window
from autotune.recording import Recording

Interval: TypeAlias = tuple[float, float]


_NONE = np.zeros((0, 0))


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
        From the family's coefficients and b's sign to what the delay still lacks, in shares of the longest interval;
        with sign 0 it is the sign of the coefficients.
    constant : (intervals, 0 or 1) array
        Integrals of the window, where a constant is estimated.
    """

    output: FloatArray
    of_input: Callable[[float], FloatArray]
    whole: FloatArray
    step: Callable[[FloatArray, float], float]
    constant: FloatArray


def modulated_by_fourier_sums(
    recording: Recording, window: SinePower, order: int, intervals: Sequence[Interval], linear: bool
) -> Modulated:
    """Return the integrals for a power of the sine, from one running sum per frequency.

    f is a sum of cosines, so each integral is a difference of int v(t) exp(j omega t) dt at the interval's ends,
    turned by its beginning: a step of the iteration costs nothing per row.

    Parameters
    ----------
    recording : Recording
        u and y over t.
    window : SinePower
        The modulating function f.
    order : int
        Order n of the equation.
    intervals : sequence of (float, float)
        Begin and end of each [s], in the recording's time.
    linear : bool
        Whether u runs linearly between its rows (else it is held).
    """
    terms = window.fourier()
    t = recording.t - recording.t[0]
    starts = np.array([T_1 for T_1, _ in intervals]) - recording.t[0]
    ends = np.array([T_2 for _, T_2 in intervals]) - recording.t[0]
    lengths = ends - starts
    same = bool(np.ptp(lengths) < 1e-9 * lengths[0])
    groups = [(lengths[0], np.arange(starts.size))] if same else [(L, np.array([i])) for i, L in enumerate(lengths)]

    def integrals(values: FloatArray, held: bool) -> Callable[[float], ComplexArray]:
        sums = [[running_fourier(t, values, omega / L, held) for _, omega in terms] for L, _ in groups]

        def at(h: float) -> ComplexArray:
            result = np.empty((starts.size, len(terms)), dtype=np.complex128)
            for (L, rows), running in zip(groups, sums, strict=True):
                first, last = starts[rows] - h, ends[rows] - h
                for q, (_, omega) in enumerate(terms):
                    part = interpolated(t, running[q], last) - interpolated(t, running[q], first)
                    result[rows, q] = part * np.exp(-1j * omega / L * first)
            return result

        return at

    y = integrals(recording.y, False)(0.0)
    of_u = integrals(recording.u, not linear)
    Y = np.zeros((starts.size, order + 1))
    for i in range(order + 1):
        for q, (c, omega) in enumerate(terms):
            Y[:, i] += (-1.0) ** i * lengths**-i * np.real(c * (1j * omega) ** i * y[:, q])

    def of_input(h: float) -> FloatArray:
        u = of_u(h)
        columns = []
        for q, (c, omega) in enumerate(terms):
            part = c * u[:, q]
            columns += [part.real] if omega == 0.0 else [part.real, -part.imag]
        return np.column_stack(columns)

    constant = terms[0][1] == 0.0
    lowest, omega = (1, terms[1][1]) if constant else (0, terms[0][1])

    def step(b: FloatArray, sign: float) -> float:
        # b cos(omega (s + d)) = b_c cos(omega s) - b_s sin(omega s): d = arctan(b_s / b_c) / omega
        sign = sign or float(np.sign(b[lowest]))
        return float(np.arctan2(sign * b[lowest + 1], sign * b[lowest]) / omega)

    whole = [1.0] * constant + [1.0, 0.0] * (len(terms) - constant)
    return Modulated(output=Y, of_input=of_input, whole=np.array(whole), step=step, constant=_NONE)


def modulated_by_expansion(
    recording: Recording, window: Window, order: int, intervals: Sequence[Interval], linear: bool, expansion: int
) -> Modulated:
    """Return the integrals for any window, whose shift by d is the sum of d^l / l! f^(l).

    Parameters
    ----------
    recording : Recording
        u and y over t.
    window : Window
        The modulating function f.
    order : int
        Order n of the equation.
    intervals : sequence of (float, float)
        Begin and end of each [s], in the recording's time.
    linear : bool
        Whether u runs linearly between its rows (else it is held).
    expansion : int
        Highest l.
    """
    Y = np.array([_output_integrals(recording, window, order, T_1, T_2) for T_1, T_2 in intervals])

    longest = max(T_2 - T_1 for T_1, T_2 in intervals)

    def of_input(h: float) -> FloatArray:
        return np.array([_input_integrals(recording, window, h, T, linear, expansion, longest) for T in intervals])

    def step(b: FloatArray, sign: float) -> float:  # b_1 / b_0, at most a quarter of an interval at once
        return float(np.clip(b[1] / b[0], -0.25, 0.25)) if b[0] != 0.0 else 0.0

    return Modulated(output=Y, of_input=of_input, whole=np.eye(expansion + 1)[0], step=step, constant=_NONE)


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


def interpolated(t: FloatArray, running: ComplexArray, at: FloatArray) -> ComplexArray:
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


def _rows(recording: Recording, T_1: float, T_2: float, shift: float) -> slice:
    """Return the rows whose stamps, shifted, lie in the interval, its ends included."""
    first = int(np.searchsorted(recording.t, T_1 - shift - 1e-9))
    last = int(np.searchsorted(recording.t, T_2 - shift + 1e-9))
    return slice(first, last)


def _output_integrals(recording: Recording, window: Window, order: int, T_1: float, T_2: float) -> FloatArray:
    """Return (-1)^i L^-i I_{y, f^(i)} for i = 0..n, by the trapezoidal rule on the rows as they are."""
    rows = _rows(recording, T_1, T_2, 0.0)
    t, y = recording.t[rows], recording.y[rows]
    length = T_2 - T_1
    weights = _trapezoid(t)
    s = (t - T_1) / length
    return np.array(
        [(-1.0) ** i * length**-i * ((weights * y) @ window.derivative(i, s)) for i in range(order + 1)],
        dtype=np.float64,
    )


def _input_integrals(
    recording: Recording,
    window: Window,
    h: float,
    interval: Interval,
    linear: bool,
    expansion: int,
    longest: float,
) -> FloatArray:
    """Return the integrals of u(t - h) against (longest/L)^l f^(l) / l!, l = 0..expansion."""
    T_1, T_2 = interval
    rows = _rows(recording, T_1, T_2, h)
    t, u = recording.t[rows], recording.u[rows]
    length = T_2 - T_1
    weights = _trapezoid(t) if linear else _held(t)
    s = (t + h - T_1) / length + (0.0 if linear else 0.5 * np.append(np.diff(t), 0.0) / length)
    wu = weights * u
    stretch = longest / length
    return np.array(
        [wu @ window.derivative(i, s) * stretch**i / math.factorial(i) for i in range(expansion + 1)],
        dtype=np.float64,
    )


def _trapezoid(t: FloatArray) -> FloatArray:
    steps = np.diff(t)
    weights = np.zeros(t.size)
    weights[:-1] += 0.5 * steps
    weights[1:] += 0.5 * steps
    return weights


def _held(t: FloatArray) -> FloatArray:
    return np.append(np.diff(t), 0.0)
