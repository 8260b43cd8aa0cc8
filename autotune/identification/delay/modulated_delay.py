"""The a-posteriori method of Ollivier, Moutaouakil and Sadik (2007), section 3: least squares on modulated intervals.

For every interval (T_1, T_2) of length L the equation of the system, multiplied by f((t - T_1)/L) and integrated by
parts, is linear in a_i, b and, after an expansion in the remaining delay, in a correction of the delay. u is then
shifted by the delay found, and the step repeated to a fixed point.

Misprint of the paper: its example prints h_0 + a cos(b_2/b_0); the step that has the fixed point is
(L/2 pi) atan2(b_2, b_1), which also takes about five iterations where an unscaled arctangent takes fifty.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from autotune.arrays import BoolArray, ComplexArray, FloatArray
from autotune.errors import IdentificationError, InputError
from autotune.identification.delay.modulating import SinePower, Window, require_window
from autotune.recording import Recording

Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class ModulatedDelay:
    """Result of the a-posteriori method.

    Attributes
    ----------
    a : tuple of n floats
        a_0..a_{n-1}.
    b, delay_s : float
        Input gain and delay [s].
    iterations : int
        Steps taken to the fixed point.
    converged : bool
        Whether the last step was below a millionth of the intervals' length.
    consistent : bool
        Whether b has the sign the delay step took it to have.
    """

    a: tuple[float, ...]
    b: float
    delay_s: float
    iterations: int
    converged: bool
    consistent: bool


def modulated_delay(
    recording: Recording,
    order: int,
    intervals: Sequence[Interval],
    *,
    window: Window | None = None,
    delay_s: float = 0.0,
    linear: bool = True,
    iterations: int = 50,
) -> ModulatedDelay:
    """Estimate a, b and h by modulating functions and least squares over intervals, iterating on h.

    Parameters
    ----------
    recording : Recording
        u from ``T_1 - h`` on, y from ``T_1`` on.
    order : int
        Order n.
    intervals : sequence of (float, float)
        (T_1, T_2) [s]; more than unknowns.
    window : SinePower or PolynomialWindow, optional
        f; sin^n for even n and sin^(n+1) for odd n where not given. Even powers of the sine are shifted exactly,
        any other window to first order in the remaining delay.
    delay_s : float
        Starting value h_0 [s].
    linear : bool
        Whether u runs linearly between rows; held otherwise.
    iterations : int
        Largest number of steps.

    Returns
    -------
    ModulatedDelay
        The fixed point, or where the iterations ended.

    Raises
    ------
    InputError
        Fewer intervals than unknowns, or a window too flat-footed.
    IdentificationError
        The iteration moved so many intervals out of the record that too few remain: the delay is beyond its basin.

    Notes
    -----
    Without noise, from h_0 = 0 and with intervals of 15 s, Example 2 is recovered for delays up to 6.8 s, at noise 5 up
    to 6 s: the basin is a bit under half the interval. Least squares with noise in its regressors is biased towards
    zero (Table 1: b = 1.94 for 2 at noise 5), and breaks under coloured noise; its standard deviations are 34 to 83
    times the Cramer-Rao bound.

    References
    ----------
    Section 3, the equation E_(T1,T2),x,u and Example 2.
    """
    window = window if window is not None else SinePower(m=order + order % 2)
    require_window(window, order)
    recording.require_finite()
    exact = isinstance(window, SinePower) and window.m % 2 == 0
    terms = window.fourier() if isinstance(window, SinePower) and exact else ()
    unknowns = order + (2 * len(terms) - 1 if exact else 2)
    if _inside(recording, intervals, 0.0).sum() < unknowns:
        raise InputError(
            f"{len(intervals)} intervals, of which {_inside(recording, intervals, 0.0).sum()} within the record, for "
            f"{unknowns} unknowns",
            where="intervals",
            remedy="give more intervals",
        )
    if exact and isinstance(window, SinePower):
        Y, of_input = _by_fourier_sums(recording, window, order, intervals, linear)
    else:
        Y = np.array([_output_integrals(recording, window, order, T_1, T_2) for T_1, T_2 in intervals])

        def of_input(h: float) -> FloatArray:
            return np.array([_input_integrals(recording, window, h, *interval, linear) for interval in intervals])

    found: list[ModulatedDelay] = []
    refusal = _leaves_the_record(recording, delay_s)
    for sign in (1.0, -1.0) if exact else (0.0,):
        try:
            found.append(_iterate(recording, intervals, Y, of_input, delay_s, sign, iterations))
        except IdentificationError as error:
            refusal = error
            continue
        if found[-1].converged and found[-1].consistent:
            return found[-1]
    if not found:
        raise refusal
    # the wrong sign has its fixed point half a window away, where b_0 and b_1 contradict each other
    return max(found, key=lambda result: (result.converged, result.consistent))


def _iterate(
    recording: Recording,
    intervals: Sequence[Interval],
    Y: FloatArray,
    of_input: Callable[[float], FloatArray],
    h: float,
    sign: float,
    iterations: int,
) -> ModulatedDelay:
    """Repeat least squares and delay step to the fixed point; sign is b's where the shift is exact, else 0."""
    n = Y.shape[1] - 1
    longest = max(T_2 - T_1 for T_1, T_2 in intervals)
    step, count = np.inf, 0
    while count < iterations and abs(step) > 1e-6 * longest:
        inside = _inside(recording, intervals, h)
        # sum (-1)^i L^-i a_i I_{y,f^(i)} + b I_{u_h,f} + .. = (-1)^n L^-n I_{y,f^(n)}
        matrix = np.column_stack([Y[:, :n], of_input(h)])[inside]
        if matrix.shape[0] < matrix.shape[1]:
            raise _leaves_the_record(recording, h)
        solution = np.linalg.lstsq(matrix, Y[inside, n], rcond=None)[0]
        b = solution[n:]
        if sign == 0.0:  # f(t + h) = f + h f' + O(h^2): h = b_1/b_0
            step = float(b[1] / b[0]) if b[0] != 0.0 else 0.0
        else:  # b c_1 cos(omega (t + h)) = b_1 c_1 cos(omega t) - b_2 c_1 sin(omega t)
            step = float(longest / (2.0 * np.pi) * np.arctan2(sign * b[2], sign * b[1]))
        h += step
        count += 1
    return ModulatedDelay(
        a=tuple(float(value) for value in solution[:n]),
        b=float(b[0]),
        delay_s=float(h),
        iterations=count,
        converged=bool(abs(step) <= 1e-6 * longest),
        consistent=bool(sign * b[0] >= 0.0),
    )


def _by_fourier_sums(
    recording: Recording, window: SinePower, order: int, intervals: Sequence[Interval], linear: bool
) -> tuple[FloatArray, Callable[[float], FloatArray]]:
    """Return the output integrals and a function of h for the input integrals, from one running sum per frequency.

    f is a sum of cosines, so each integral is a difference of int v(t) exp(j omega t) dt at the interval's ends,
    turned by its beginning: a step of the iteration costs nothing per row.
    """
    terms = window.fourier()
    t = recording.t - recording.t[0]
    starts = np.array([T_1 for T_1, _ in intervals]) - recording.t[0]
    ends = np.array([T_2 for _, T_2 in intervals]) - recording.t[0]
    lengths = ends - starts
    same = bool(np.ptp(lengths) < 1e-9 * lengths[0])
    groups = [(lengths[0], np.arange(starts.size))] if same else [(L, np.array([i])) for i, L in enumerate(lengths)]

    def integrals(values: FloatArray, held: bool) -> Callable[[float], ComplexArray]:
        sums = [[_running_fourier(t, values, omega / L, held) for _, omega in terms] for L, _ in groups]

        def at(h: float) -> ComplexArray:
            result = np.empty((starts.size, len(terms)), dtype=np.complex128)
            for (L, rows), running in zip(groups, sums, strict=True):
                first, last = starts[rows] - h, ends[rows] - h
                for q, (_, omega) in enumerate(terms):
                    part = _interpolated(t, running[q], last) - _interpolated(t, running[q], first)
                    result[rows, q] = part * np.exp(-1j * omega / L * first)
            return result

        return at

    y = integrals(recording.y, False)(0.0)
    of_u = integrals(recording.u, not linear)
    Y = np.zeros((starts.size, order + 1))
    for i in range(order + 1):
        for q, (c, omega) in enumerate(terms):
            # the i-th derivative of cos(omega s) is Re (j omega)^i exp(j omega s)
            Y[:, i] += (-1.0) ** i * c * lengths**-i * np.real((1j * omega) ** i * y[:, q])

    def of_input(h: float) -> FloatArray:
        u = of_u(h)
        columns = [terms[0][0] * u[:, 0].real]
        for q, (c, _) in enumerate(terms[1:], start=1):
            columns += [c * u[:, q].real, -c * u[:, q].imag]
        return np.column_stack(columns)

    return Y, of_input


@njit(cache=True)
def _running_fourier(t: FloatArray, values: FloatArray, omega: float, held: bool) -> ComplexArray:
    """Return int v(s) exp(j omega s) ds from t[0] to every row: trapezoidal, or with v held between rows."""
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


def _interpolated(t: FloatArray, running: ComplexArray, at: FloatArray) -> ComplexArray:
    row = np.clip(np.searchsorted(t, at) - 1, 0, t.size - 2)
    share = (at - t[row]) / (t[row + 1] - t[row])
    return np.asarray(running[row] + share * (running[row + 1] - running[row]), dtype=np.complex128)


def _inside(recording: Recording, intervals: Sequence[Interval], h: float) -> BoolArray:
    """Return which intervals, shifted back by the delay, lie within the record."""
    ends = np.asarray(intervals, dtype=np.float64) - h
    slack = 1.5 * (recording.t[-1] - recording.t[0]) / (len(recording) - 1)
    inside = (ends[:, 0] >= recording.t[0] - slack) & (ends[:, 1] <= recording.t[-1] + slack)
    return np.asarray(inside, dtype=np.bool_)


def _leaves_the_record(recording: Recording, h: float) -> IdentificationError:
    return IdentificationError(
        f"with a delay of {h:.4g} s the intervals leave the record",
        where=recording.name,
        remedy="start nearer to the delay, take shorter intervals, or use identify_delay, which needs no start",
    )


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
    recording: Recording, window: Window, h: float, T_1: float, T_2: float, linear: bool
) -> FloatArray:
    """Return the integrals of u(t - h) against f and f'."""
    rows = _rows(recording, T_1, T_2, h)
    t, u = recording.t[rows], recording.u[rows]
    length = T_2 - T_1
    weights = _trapezoid(t) if linear else _held(t)
    s = (t + h - T_1) / length + (0.0 if linear else 0.5 * np.append(np.diff(t), 0.0) / length)
    wu = weights * u
    return np.array([wu @ window.derivative(0, s), wu @ window.derivative(1, s) / length])


def _trapezoid(t: FloatArray) -> FloatArray:
    steps = np.diff(t)
    weights = np.zeros(t.size)
    weights[:-1] += 0.5 * steps
    weights[1:] += 0.5 * steps
    return weights


def _held(t: FloatArray) -> FloatArray:
    return np.append(np.diff(t), 0.0)
