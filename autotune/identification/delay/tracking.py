"""Parameters over time: the delay model fitted to one window of a record after another, each with its covariance."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError, InputError
from autotune.identification.answer import require_answer, require_order
from autotune.identification.delay.data import prepare
from autotune.identification.delay.drift import mean_over_window
from autotune.identification.delay.identify import identify_delay
from autotune.identification.delay.model import DelayModel
from autotune.identification.delay.output_error import Structure
from autotune.models import Hold
from autotune.recording import Recording

#: More windows take memory before the first is fitted, and time without end.
_MOST_WINDOWS = 1e7


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A number an operator knows the plant by, with its standard deviation."""

    name: str
    value: float
    sd: float
    unit: str


@dataclass(frozen=True, kw_only=True)
class Window:
    """What one window said.

    Attributes
    ----------
    end_s : float
        Time stamp of the window's end [s].
    model : DelayModel or None
        None where the window did not determine it.
    reason : str
        Why not, empty otherwise.
    """

    end_s: float
    model: DelayModel | None
    reason: str = ""


def track(
    recording: Recording,
    order: int,
    *,
    window_s: float,
    every_s: float,
    max_delay_s: float | None = None,
    hold: Hold | None = None,
    integrator: bool = False,
    after_s: float = -np.inf,
) -> Iterator[Window]:
    """Fit the delay model to windows that slide over a recording.

    Parameters
    ----------
    recording : Recording
        Normal operation, in open or closed loop.
    order : int
        Order n.
    window_s : float
        Length of y that each fit uses [s]; u before it serves as its past.
    every_s : float
        Time between the ends of two windows [s].
    max_delay_s : float, optional
        Largest delay considered [s]; half the window where not given.
    hold : {"zero", "linear"}, optional
        How u runs between rows.
    integrator : bool
        Whether a_0 = 0 is known.
    after_s : float
        Windows that end up to here have been done and are left out [s].

    Yields
    ------
    Window
        In time order; only rows up to the window's end are used.

    Raises
    ------
    InputError
        A window longer than the recording, or times that are not positive.
    IdentificationError
        Over the whole recording u answers y, and y does not answer u.

    Notes
    -----
    A model is that of the parameters' means over the window: where they moved within it, linearly in time, the means
    and their intervals are those of a fit that lets them (:mod:`autotune.identification.delay.drift`). A window that
    excites too little is reported with the reason, not bridged; rows without a y, as a link loses them, are left out.
    """
    begin, end = float(recording.t[0]), float(recording.t[-1])
    if not every_s > 0.0 or not 0.0 < window_s <= end - begin:
        raise InputError(
            f"window {window_s:g} s every {every_s:g} s on a record of {end - begin:.4g} s",
            where=recording.name,
            remedy="give positive times and a window shorter than the record",
        )
    largest = 0.5 * window_s if max_delay_s is None else max_delay_s
    last: DelayModel | None = None
    if (end - begin) / every_s > _MOST_WINDOWS:
        raise InputError(
            f"a window every {every_s:g} s on {end - begin:.4g} s makes {(end - begin) / every_s:.2g} of them",
            where=recording.name, remedy="give a longer time between them, or cut the recording at its gap",
        )  # fmt: skip
    if not after_s > begin:  # what no window is long enough to tell
        require_order([recording])
    ends = begin + window_s + every_s * np.arange(int((end - begin - window_s) / every_s + 1e-9) + 1)
    for at in ends[ends > after_s + 1e-6 * every_s]:
        if np.sum((recording.t > at - window_s) & (recording.t <= at)) < 2:
            yield Window(end_s=float(at), model=None, reason="no rows in it: a gap")
            continue
        part = recording.between(at - window_s - largest, at + 1e-9 * window_s)

        def fit(start: DelayModel | None, part: Recording = part, at: float = float(at)) -> DelayModel:
            return identify_delay(
                part,
                order,
                max_delay_s=largest,
                hold=hold,
                start_s=at - window_s,
                integrator=integrator,
                skip_missing=True,
                start=start,
            )

        try:
            require_answer([part.between(at - window_s, np.inf)])  # the rows of y that are fitted
            last = _fit_window(fit, last)
            data = prepare(part, hold=hold, start_s=at - window_s, skip_missing=True)
            structure = Structure(order=order, integrator=integrator)
            yield Window(end_s=float(at), model=mean_over_window(data, structure, last))
        except IdentificationError as error:
            yield Window(end_s=float(at), model=None, reason=error.what)


def choose_structure(
    recording: Recording,
    *,
    window_s: float,
    max_delay_s: float | None = None,
    hold: Hold | None = None,
    integrator: bool = False,
) -> Structure | None:
    """Return the order, 2 or 1, that a recording's windows determine, and whether its plant integrates.

    Parameters
    ----------
    recording : Recording
        Normal operation, in open or closed loop.
    window_s : float
        Length of the windows that are to be fitted [s].
    max_delay_s : float, optional
        Largest delay considered [s]; half the window where not given.
    hold : {"zero", "linear"}, optional
        How u runs between rows.
    integrator : bool
        Whether a_0 = 0 is known.

    Returns
    -------
    Structure or None
        Of the window that determines one and in which u moves most. It has an integrator where the 95 % interval of a_0
        holds zero: that of the gain -b/a_0 would then have no end. None where no window determines either order.
    """
    largest = 0.5 * window_s if max_delay_s is None else max_delay_s
    starts = np.arange(recording.t[0], recording.t[-1] - window_s * (1.0 - 1e-9), window_s)
    windows = [recording.between(float(start), float(start) + window_s) for start in starts]
    for window in sorted(windows, key=lambda part: -float(np.nansum(np.abs(np.diff(part.u))))):
        for order in (2, 1):
            try:
                require_answer([window])
                model = identify_delay(
                    window, order, max_delay_s=largest, hold=hold, integrator=integrator, skip_missing=True
                )
            except IdentificationError:
                continue
            unbounded = abs(model.a[0]) <= 1.96 * model.standard_deviations[0]
            return Structure(order=order, integrator=integrator or bool(unbounded))
    return None


def _fit_window(fit: Callable[[DelayModel | None], DelayModel], last: DelayModel | None) -> DelayModel:
    """Start from the last window's model, and search anew where that explains the window clearly worse."""
    if last is not None:
        try:
            near = fit(last)
        except IdentificationError:
            near = None
        if near is not None and near.noise_sd < 1.2 * last.noise_sd:
            return near
    return fit(None)


def quantities(model: DelayModel) -> tuple[Quantity, ...]:
    """Return gain, dead time and time constants with their standard deviations, by the delta method.

    The gain is -b/a_0, or with an integrator b over the product of the other poles, per second. Time constants are
    1/abs(pole), longest first; a complex pair has the same one twice.
    """
    n = model.order
    covariance = model.covariance[: n + 2, : n + 2]
    integrating = model.covariance[0, 0] == 0.0 and model.a[0] == 0.0

    def of(values: FloatArray) -> FloatArray:
        a, b, h = values[:n], values[n], values[n + 1]
        roots = np.roots([1.0, *(-a[::-1])])
        size = np.sort(np.abs(roots))[int(integrating) :]
        gain = -b / a[int(integrating)] if n > int(integrating) else b
        return np.array([gain, h, *(1.0 / size)], dtype=np.float64)

    values = model.values[: n + 2]
    sds = model.standard_deviations[: n + 2]
    found = of(values)
    jacobian = np.zeros((found.size, n + 2))
    for i in np.flatnonzero(sds):
        step = np.zeros(n + 2)
        step[i] = 1e-3 * sds[i]
        jacobian[:, i] = (of(values + step) - of(values - step)) / (2.0 * step[i])
    sd = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian), 0.0))
    names = ["gain", "dead time", *(f"time constant {i + 1}" for i in range(found.size - 2))]
    units = ["y/u/s" if integrating else "y/u", *["s"] * (found.size - 1)]
    return tuple(
        Quantity(name=name, value=float(value), sd=float(s), unit=unit)
        for name, value, s, unit in zip(names, found, sd, units, strict=True)
    )
