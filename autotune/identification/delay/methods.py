"""The paper's two estimates of a delay brought into the form of the output-error one: a delay model with covariance."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import numpy as np
from scipy.special import ndtri, stdtrit

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError, InputError
from autotune.identification.delay.data import DelayData, prepare
from autotune.identification.delay.model import DelayModel
from autotune.identification.delay.online_modulating import DelayTracking, OnlineEstimator, OnlineSample
from autotune.identification.delay.output_error import Structure, residuals, solve_linear
from autotune.identification.delay.output_error_model import colour_of, parameters
from autotune.identification.delay.weighted_delay import weighted_delay
from autotune.models import Hold
from autotune.recording import Recording

#: Intervals in a record where no length is given.
_INTERVALS = 7.0
#: Rows that an interval has for each derivative.
_ROWS_PER_DERIVATIVE = 8
#: Kernels forget this many times in a record, where no rate is given; the first half of it is run in.
_FORGETS = 100.0
#: Times that the on-line estimate is compared with what it makes of its own model's response.
_SIMULATIONS = 12
#: Draws of noise on its own model's response, from which the covariance comes, rows before each, and times.
_DRAWS, _SETTLING, _MATCHES = 24, 200, 2
#: Change that ends this, as a share of the values: rounding, or what is small beside the noise.
_ROUNDING, _SHARE_OF_NOISE = 1e-10, 1e-4


def algebraic_delay(
    recording: Recording,
    order: int,
    *,
    interval_s: float | None = None,
    start_s: float | None = None,
    hold: Hold | None = None,
) -> DelayModel:
    """Estimate a, b and h by modulating functions on overlapping intervals, weighted by the noise in them.

    The paper's own least squares, biased by noise, is
    :func:`autotune.identification.delay.modulated_delay.modulated_delay`.

    Parameters
    ----------
    recording : Recording
        t, u, y; means are removed.
    order : int
        Order n.
    interval_s : float, optional
        Length of an interval [s], several times the delay; a seventh of the record when absent.
    start_s : float, optional
        A delay that is tried besides those of a grid [s].
    hold : {"zero", "linear"}, optional
        How u runs between rows; the sidecar's ``hold`` where not given, else zero-order hold.

    Returns
    -------
    DelayModel
        Initial state and noise are those that fit the record best with these a and h; the initial state has no
        covariance (NaN).

    Raises
    ------
    InputError
        Intervals of too few rows, or as long as the record.
    IdentificationError
        The equations do not determine a, b and h.

    Notes
    -----
    Delays up to half of what the record is longer than an interval. Noise may be coloured; it is taken as
    autoregressive. What is faster than the sixth harmonic of an interval is not used.
    """
    data = prepare(recording, hold=hold)
    span = float(data.ty[-1] - data.ty[0])
    length = span / _INTERVALS if interval_s is None else interval_s
    _require_length(length, order, recording)
    values, covariance = weighted_delay(data, order, length, start_s=start_s)
    return _model(data, order, values, covariance)


def _require_length(length: float, order: int, recording: Recording) -> None:
    """Refuse intervals that hold too few rows for the derivatives of the modulating functions, or the whole record."""
    span = float(recording.t[-1] - recording.t[0])
    least = _ROWS_PER_DERIVATIVE * (order + 1) * span / (len(recording.t) - 1)
    if not least <= length < span:
        raise InputError(
            f"intervals of {length:.4g} s",
            where="--interval",
            remedy=f"between {least:.3g} s ({_ROWS_PER_DERIVATIVE * (order + 1)} rows) and the record's {span:.4g} s",
        )


def online_delay(
    recording: Recording, order: int, *, forgetting: float | None = None, start_s: float, hold: Hold | None = None
) -> DelayModel:
    """Follow a, b and h through a recording row by row, and return where they ended.

    Parameters
    ----------
    recording : Recording
        t, u, y; means are removed.
    order : int
        Order n.
    forgetting : float, optional
        lambda of the kernels [1/s]; 100 over the record's length when absent.
    start_s : float
        Delay the tracking begins with [s].
    hold : {"zero", "linear"}, optional
        How u runs between rows.

    Returns
    -------
    DelayModel
        The last row's estimates, with the covariance of what is followed on the model's own response under noise of the
        residual's variance and colour. The mean that noise moves these by is taken off, and counted as
        uncertainty besides, which makes intervals rather too wide than too narrow.

    Raises
    ------
    IdentificationError
        Lock was lost, or noise as it is here would make it lost.
    """
    data = prepare(recording, hold=hold)
    span = float(data.ty[-1] - data.ty[0])
    rate = _FORGETS / span if forgetting is None else forgetting

    def followed(y: FloatArray, start: float) -> OnlineSample:
        tracking = DelayTracking(start_s=start, after_s=0.5 * span, rate=0.4 * rate, longest_s=span)
        estimator = OnlineEstimator(order, forgetting=rate, delay=tracking, linear=data.linear, offset=True)
        return estimator.run(data.tu, data.u, y)

    last = followed(data.y, start_s)
    seen = values = _values(last)
    for _ in range(_SIMULATIONS):  # what it makes of its own model's response, which is known, is taken off
        response = _response(data, order, values)
        if response is None:
            return _model(data, order, values, last.covariance)
        own, y, residual, whitening = response
        values, before = seen - _values(followed(y, start_s)) + own, values
        noise = float(np.std(residual) / np.std(data.y))
        if np.all(np.abs(values - before) <= max(_ROUNDING, _SHARE_OF_NOISE * noise) * np.abs(values)):
            break
    corrected = values
    for _ in range(_MATCHES):  # the bias of least squares with noise in its regressors, at the estimate that it leaves
        draws = _under_noise(
            lambda y: followed(y, start_s), y, _noise_like(residual, whitening, len(y)), recording.name
        )
        bias = np.mean(draws, axis=0) - _values(followed(y, start_s))
        corrected = values - bias
        response = _response(data, order, corrected)
        if response is None:
            break
        _, y, residual, whitening = response
    return _model(data, order, corrected, _spread(draws) + np.outer(bias, bias))


def _under_noise(
    followed: Callable[[FloatArray], OnlineSample], y: FloatArray, noise: Iterator[FloatArray], name: str
) -> FloatArray:
    """Return what is followed on a response under drawn noise, (draws, values); draws that lose lock are left out."""
    draws = []
    for drawn in noise:
        with contextlib.suppress(IdentificationError):
            draws.append(_values(followed(y + drawn)))
    if len(draws) < _DRAWS // 2:
        raise IdentificationError(
            "under noise as it is here the delay cannot be followed",
            where=name,
            remedy="start nearer to the delay, forget more slowly, or take --method algebraic",
        )
    return np.array(draws)


def _values(sample: OnlineSample) -> FloatArray:
    return np.array([*sample.a, sample.b, sample.delay_s])


def _noise_like(residual: FloatArray, whitening: FloatArray, rows: int) -> Iterator[FloatArray]:
    """Yield records of noise with the residual's variance and that colour."""
    from scipy.signal import lfilter  # here: it takes long to import, and few recordings come this way

    colour = np.array([1.0, *whitening])
    innovations = lfilter(colour, [1.0], residual)[colour.size - 1 :]
    rng = np.random.default_rng(0)
    for _ in range(_DRAWS):
        white = float(np.std(innovations)) * rng.standard_normal(rows + _SETTLING)
        yield np.asarray(lfilter([1.0], colour, white)[_SETTLING:])


def _spread(draws: FloatArray) -> FloatArray:
    """Return the covariance of estimates, larger by what few draws leave open: 1.96 sd are a 95 % interval."""
    open_left = float(stdtrit(len(draws) - 1, 0.975) / ndtri(0.975)) ** 2
    return np.asarray(np.cov(draws.T) * open_left)


def _response(
    data: DelayData, order: int, values: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None:
    """Return the best model with these a and h, its response, what that leaves of y, and what makes this white.

    None if the response overflows.
    """
    a, h = tuple(values[:order].tolist()), max(float(values[order + 1]), 0.0)
    usable = data.usable_from(h)
    point = solve_linear(usable, Structure(order=order), a, h)
    if not np.isfinite(point.cost):
        return None
    y, residual = data.y.copy(), residuals(usable, point)
    y[-usable.y.size :] -= residual
    whitening = colour_of(usable, Structure(order=order), point).whitening.ar
    return np.array([*a, point.theta[0], h]), y, residual, whitening


def _model(data: DelayData, order: int, values: FloatArray, covariance: FloatArray) -> DelayModel:
    """Return the model of (a, b, h) or (a, b, h, d) with the initial state, noise and d that go with a and h."""
    a, h = tuple(float(value) for value in values[:order]), max(float(values[order + 1]), 0.0)
    usable = data.usable_from(h)
    point = solve_linear(usable, Structure(order=order), a, h)
    rest = parameters(usable, point)
    known = len(values)
    back = np.eye(2 * order + 3, known)
    if known > order + 2:  # d about the operating point
        back[order + 2, [0, order]] = -data.y_0, -data.u_0
        rest[order + 2] = back[order + 2] @ values
    whole = back @ covariance @ back.T
    whole[known:], whole[:, known:] = np.nan, np.nan
    sd = float(np.sqrt(point.cost / max(point.rows - 2 * order - 3, 1)))
    return DelayModel(
        a=a,
        b=float(values[order]),
        delay_s=h,
        constant=float(rest[order + 2]),
        initial_time_s=float(usable.ty[0]),
        initial_state=tuple(float(value) for value in rest[order + 3 :]),
        covariance=whole,
        noise_sd=sd,
        rows=point.rows,
    )
