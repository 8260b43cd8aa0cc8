"""The paper's two estimates of a delay brought into the form of the output-error one: a delay model with covariance."""

from __future__ import annotations

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError, InputError
from autotune.identification.delay.data import DelayData, prepare
from autotune.identification.delay.model import DelayModel
from autotune.identification.delay.modulated_delay import ModulatedDelay, modulated_delay
from autotune.identification.delay.online_modulating import DelayTracking, OnlineEstimator
from autotune.identification.delay.output_error import Structure, parameters, solve_linear
from autotune.models import Hold
from autotune.recording import Recording

#: Intervals in a record where no length is given, and how many of them overlap at any time.
_INTERVALS, _OVERLAP = 7.0, 3
_JACKKNIFE = 12
#: Rows that an interval has for each derivative, and most intervals, which are then spaced out over the record.
_ROWS_PER_DERIVATIVE, _MOST_INTERVALS = 8, 2000
#: Kernels forget this many times in a record, where no rate is given; the first half of it is run in.
_FORGETS = 100.0


def algebraic_delay(
    recording: Recording, order: int, *, interval_s: float | None = None, start_s: float = 0.0, hold: Hold | None = None
) -> DelayModel:
    """Estimate a, b and h by modulating functions on overlapping intervals, with a jackknife's covariance.

    Parameters
    ----------
    recording : Recording
        t, u, y; means are removed.
    order : int
        Order n.
    interval_s : float, optional
        Length of an interval [s], several times the delay; a seventh of the record when absent.
    start_s : float
        Starting value of the delay [s].
    hold : {"zero", "linear"}, optional
        How u runs between rows; the sidecar's ``hold`` where not given, else zero-order hold.

    Returns
    -------
    DelayModel
        Constant, initial state and noise are those that fit the record best with these a and h.

    Raises
    ------
    InputError
        Intervals of too few rows, or as long as the record.
    IdentificationError
        No fixed point of the iteration is the delay.

    Notes
    -----
    Biased towards zero by noise on y, and not efficient (:func:`modulated_delay`); the covariance is that of leaving
    out stretches of the record and does not hold the bias.
    """
    data = prepare(recording, hold=hold)
    centred = _centred(recording, data)
    span = float(centred.t[-1] - centred.t[0])
    length = span / _INTERVALS if interval_s is None else interval_s
    _require_length(length, order, centred)
    count = min(max(2, int((span - length) / length * _OVERLAP) + 1), _MOST_INTERVALS)
    begins = centred.t[0] + (span - length) * np.arange(count) / (count - 1)
    intervals = [(float(at), float(at + length)) for at in begins]
    found = _converged(
        modulated_delay(centred, order, intervals, delay_s=start_s, linear=data.linear, offset=True), recording
    )
    spread = []
    for part in np.array_split(np.arange(count), min(_JACKKNIFE, count // (order + 4))):
        kept = [interval for i, interval in enumerate(intervals) if i not in part]
        if len(kept) > order + 4:
            one = modulated_delay(centred, order, kept, delay_s=found.delay_s, linear=data.linear, offset=True)
            spread += [[*one.a, one.b, one.delay_s]] if one.converged else []
    values = np.array([*found.a, found.b, found.delay_s])
    if len(spread) < 3:
        raise IdentificationError(
            f"{count} intervals are too few to tell how well the parameters are known",
            where=recording.name,
            remedy="give a shorter --interval, or record longer",
        )
    off = np.array(spread) - np.mean(spread, axis=0)
    # neighbouring stretches share intervals: the overlap counts as so many fewer independent ones
    covariance = (len(spread) - 1) / len(spread) * off.T @ off * min(_OVERLAP, 2)
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


def _converged(found: ModulatedDelay, recording: Recording) -> ModulatedDelay:
    if not found.converged:
        raise IdentificationError(
            f"the iteration on the delay has no fixed point that explains the record (nearest: {found.delay_s:.4g} s)",
            where=recording.name,
            remedy="give intervals several times as long as the delay, another --order, or --method output-error",
        )
    return found


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
        The last row's estimates with their covariance.

    Raises
    ------
    IdentificationError
        Lock was lost.
    """
    data = prepare(recording, hold=hold)
    centred = _centred(recording, data)
    span = float(centred.t[-1] - centred.t[0])
    rate = _FORGETS / span if forgetting is None else forgetting
    tracking = DelayTracking(start_s=start_s, after_s=0.5 * span, rate=0.4 * rate, longest_s=span)
    estimator = OnlineEstimator(order, forgetting=rate, delay=tracking, linear=data.linear, offset=True)
    for row in zip(centred.t.tolist(), centred.u.tolist(), centred.y.tolist(), strict=True):
        last = estimator.step(*row)
    return _model(data, order, np.array([*last.a, last.b, last.delay_s]), last.covariance)


def _centred(recording: Recording, data: DelayData) -> Recording:
    return Recording(t=data.tu, u=data.u, y=recording.y - data.y_0, name=recording.name)


def _model(data: DelayData, order: int, values: FloatArray, covariance: FloatArray) -> DelayModel:
    """Return the model of (a, b, h) with the constant, the initial state and the noise that go with a and h."""
    a, h = tuple(float(value) for value in values[:order]), max(float(values[order + 1]), 0.0)
    usable = data.usable_from(h)
    point = solve_linear(usable, Structure(order=order), a, h)
    rest = parameters(usable, point)
    whole = np.zeros((2 * order + 3, 2 * order + 3))
    whole[: order + 2, : order + 2] = covariance
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
