"""Identification of x^(n) = sum a_i x^(i) + b u(t - h) + d from a recording, without a starting value.

The model class and its sign convention are those of Ollivier, Moutaouakil and Sadik (2007); the estimate is the
output-error one their starred values are, reached from an instrumental-variable search over a grid of delays.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autotune.errors import IdentificationError, InputError
from autotune.identification.answer import latest_answer_s
from autotune.identification.delay.data import DelayData, PastInput, input_period, prepare
from autotune.identification.delay.model import DelayModel
from autotune.identification.delay.output_error import Point, Structure, minimise, residuals, solve_linear
from autotune.identification.delay.output_error_model import finish, polish, widen_intervals
from autotune.identification.delay.profile import profile
from autotune.identification.delay.search import average_bins, scan, search
from autotune.identification.noise_colour import whitening_filter
from autotune.identification.noise_filter import WHITE
from autotune.models import Hold
from autotune.progress import Progress, quiet
from autotune.recording import Recording

_MIDDLE_BINS = 6000
_SCANNED_BINS = 2400
#: relative standard deviation of b above which the order is refused: from order 3 on, linearised intervals fail earlier
_UNDETERMINED = {1: 0.5, 2: 0.5, 3: 0.2, 4: 0.2}
#: relative standard deviation of b below which the sum of squares is a paraboloid as far as the intervals reach
_LINEAR = 0.01
_MINIMA = 4
_AT_REST = 3  # rows in which u stays as it is
_COMPARED_ORDER = 3
#: rise of the sum of squares, in residual variances and logarithms of the rows, that an order must be worth: what the
#: Bayes information criterion asks for a coefficient and an initial state
_NEEDED = 2.0
_COMPARED = 3
_ALIKE = 6.0  # residual variances: a hundredth of the rightful minimum's chance
MAX_ORDER = 4


def identify_delay(
    recording: Recording,
    order: int,
    *,
    max_delay_s: float | None = None,
    hold: Hold | None = None,
    past_input: PastInput = "unknown",
    start_s: float | None = None,
    integrator: bool = False,
    offset: bool = True,
    coloured: bool = True,
    skip_missing: bool = False,
    start: DelayModel | None = None,
    every: int = 1,
    progress: Progress = quiet,
) -> DelayModel:
    """Estimate coefficients, gain, delay, operating point and initial state, with their covariance.

    Parameters
    ----------
    recording : Recording
        Rows of t, u, y; the stamps need not be uniform.
    order : int
        Order n, 1 to 4.
    max_delay_s : float, optional
        Largest delay considered [s]. Where not given, half the record, or half the period where u is periodic: a
        relay's limit cycle looks the same with half a period more of delay and b reversed. Where a controller makes u
        of y, no more than the time within which y is seen to answer u.
    hold : {"zero", "linear"}, optional
        How u runs between rows; the sidecar's ``hold`` where not given, else zero-order hold.
    past_input : {"unknown", "held", "zero"}
        What u was before the first row; where unknown, rows of y that would need it are left out.
    start_s : float, optional
        Time stamp from which y is used [s]; earlier rows serve as the input's past.
    integrator : bool
        Whether a_0 = 0 is known.
    offset : bool
        Whether a constant d is estimated: an offset of y or u, or a constant load.
    coloured : bool
        Whether the noise may be autoregressive; white is assumed otherwise.
    skip_missing : bool
        Whether rows whose y is NaN, lost samples, are left out; refused otherwise.
    start : DelayModel, optional
        A model to begin with instead of the search, as when a window of a record follows another.
    every : int
        One row of y in so many is fitted, for a first look at a long record.
    progress : callable, optional
        Told what is being done and the share done.

    Returns
    -------
    DelayModel
        The maximum-likelihood estimate under the noise model.

    Raises
    ------
    InputError
        An order outside 1 to 4, NaN, or a largest delay outside the record.
    IdentificationError
        Constant input, an output that does not move, a gap, or data that do not determine the parameters; names what
        cannot be told apart and the experiment that would tell.

    Notes
    -----
    The covariance is the inverse information at the estimate; where b is known to no better than 1 %, its standard
    deviations are widened to the likelihood intervals. Both are right only if the structure is. From order 3 on an
    order that the next lower one does without, by the Bayes information criterion, is refused. In closed loop the
    estimate is consistent where the noise model is right and the loop has a delay.

    References
    ----------
    F. Ollivier, S. Moutaouakil, B. Sadik, Une methode d'identification pour un systeme lineaire a retards, 2007,
    section 3 and Table 1.
    """
    if not 1 <= order <= MAX_ORDER:
        raise InputError(f"order {order}", where="order", remedy=f"orders 1 to {MAX_ORDER} are supported")
    structure = Structure(order=order, integrator=integrator, offset=offset)
    data = prepare(
        recording, hold=hold, past_input=past_input, start_s=start_s, offset=offset, skip_missing=skip_missing
    ).thinned(every)
    largest = _largest_delay(data, max_delay_s)
    if max_delay_s is None and (answered_s := latest_answer_s(recording)) is not None:
        largest = min(largest, answered_s)
    if data.ty.size < 3 * structure.parameters:
        raise _too_short(data, structure)
    if start is not None:
        near = Point(a=start.a, h=start.delay_s, theta=np.zeros(2 + order), cost=np.inf, rows=0)
        return _polish_on_all_rows(data, data, structure, near, largest, coloured)
    progress("searching the delay", 0.0)
    searched = _as_if_held(data)
    candidates = search(searched, structure, max_delay_s=largest)
    finest = min(c.rows_per_bin for c in candidates)
    bins = max(_MIDDLE_BINS, 10 * data.ty.size // finest)
    middle = average_bins(searched, bins)
    best = _best_on_common_rows(middle, structure, [c.point for c in candidates], largest)
    if _is_ambiguous(middle, structure, best):
        progress("comparing delays", 0.6)
        best = scan(average_bins(middle, _SCANNED_BINS), structure, best, max_delay_s=largest)
    middle = average_bins(data, bins)
    progress("fitting", 0.8)
    return _polish_on_all_rows(data, middle, structure, best, largest, coloured)


def _as_if_held(data: DelayData) -> DelayData:
    """Return the record with u held before it began as it rests in its first rows, where nobody knows what it was.

    What a delay cannot explain for want of that past would be left out of its cost, and a delay as long as half of a
    step test leaves out the step: every delay would explain the rest. The minimum so found is fitted without it.
    """
    if data.before is not None or float(np.ptp(data.u[:_AT_REST])) > 0.0:
        return data
    return replace(data, before=float(data.u[0]))


def _largest_delay(data: DelayData, max_delay_s: float | None) -> float:
    reach = float(data.ty[-1] - data.tu[0])
    if max_delay_s is None:
        period = input_period(data)
        return 0.5 * reach if np.isnan(period) else min(0.5 * reach, 0.5 * period)
    if not 0.0 <= max_delay_s < reach:
        raise InputError(
            f"largest delay {max_delay_s:g} s lies outside the record of {reach:.4g} s",
            where=data.name,
            remedy=f"give --max-delay between 0 and {reach:.4g}, or record longer",
        )
    return max_delay_s


def _best_on_common_rows(data: DelayData, structure: Structure, candidates: list[Point], largest: float) -> Point:
    """Fit the candidates on finer bins, and compare them on the rows that all of them can explain."""
    limit = min(max(c.h for c in candidates) * 1.02 + 0.01 * largest, largest)
    common = data.usable_from(limit)
    if common.ty.size < 3 * structure.parameters:
        raise _too_short(data, structure)
    starts = sorted((solve_linear(common, structure, c.a, c.h) for c in candidates), key=lambda point: point.cost)
    fitted = [
        minimise(common, structure, start, max_delay_s=limit, tolerance=1e-2)
        for start in starts[:_COMPARED]
        if start.cost < 4.0 * starts[0].cost
    ]
    best = min(fitted, key=lambda point: point.cost, default=starts[0])
    # of those that explain the record alike, as under a periodic input, the shortest delay
    alike = [point for point in fitted if point.cost <= best.cost * (1.0 + _ALIKE / best.rows)]
    best = min(alike, key=lambda point: point.h, default=best)
    if not np.isfinite(best.cost):
        raise IdentificationError(
            f"no model of order {structure.order} explains the record with a finite response",
            where=data.name,
            remedy="an unstable plant needs a recording in closed loop that is short against its growth",
        )
    return best


def _is_ambiguous(data: DelayData, structure: Structure, point: Point) -> bool:
    """Whether the point may not be the lowest minimum: something is left in the residual, or b is hardly determined."""
    usable = data.usable_from(point.h)
    here = solve_linear(usable, structure, point.a, point.h)
    if whitening_filter(residuals(usable, here), max_order=2).size > 0:
        return True
    model = finish(usable, structure, here)
    return bool(model.standard_deviations[structure.order] > _LINEAR * abs(model.b))


def _polish_on_all_rows(
    data: DelayData, middle: DelayData, structure: Structure, best: Point, largest: float, coloured: bool
) -> DelayModel:
    step = float(np.median(np.diff(data.tu)))
    for _ in range(4):
        limit = min(best.h + max(0.05 * best.h, 5.0 * step), largest)
        rough = middle.usable_from(limit)
        if rough.ty.size < 3 * structure.parameters:
            raise _too_short(data, structure)
        best = minimise(
            rough, structure, solve_linear(rough, structure, best.a, best.h), max_delay_s=limit, tolerance=1e-3
        )
        sd = finish(rough, structure, best).standard_deviations[structure.order + 1]
        if best.h < limit or limit >= largest:
            break
    whitening = WHITE
    for _ in range(_MINIMA):
        limit = min(best.h + 8.0 * float(sd) + 2.0 * step, largest)
        usable = data.usable_from(limit)
        best, colour = polish(usable, structure, best, max_delay_s=limit, coloured=coloured, whitening=whitening)
        whitening = colour.whitening
        model = finish(usable, structure, best, whitening)
        _require_inside(data, model, largest)
        if model.standard_deviations[structure.order] < _LINEAR * abs(model.b):
            return widen_intervals(model, structure, colour)
        if structure.order >= _COMPARED_ORDER:
            _require_order(data, structure, best, model, largest)
        _require_determined(data, model, largest)
        found = profile(usable, structure, best, model, max_delay_s=limit)
        if found.endless:
            raise _refusal_of_order(data, found.model, largest, f"nothing bounds {found.endless}")
        if found.lower is None:
            _require_determined(data, found.model, largest)
            return widen_intervals(found.model, structure, colour)
        best = found.lower
    raise _refusal_of_order(data, model, largest, "several sets of parameters explain it alike")


def _require_inside(data: DelayData, model: DelayModel, largest: float) -> None:
    if model.delay_s >= largest * (1.0 - 1e-9):
        raise IdentificationError(
            f"the delay lies at or beyond the largest one considered, {largest:.4g} s",
            where=data.name,
            remedy="give a larger --max-delay, and a record several times as long as the delay",
        )


def _require_determined(data: DelayData, model: DelayModel, largest: float) -> None:
    sd = model.standard_deviations
    n = model.order
    if sd[n] > _UNDETERMINED[n] * abs(model.b):
        why = f"the standard deviation of b is {100 * sd[n] / abs(model.b):.0f} % of it"
        raise _refusal_of_order(data, model, largest, why)


def _require_order(data: DelayData, structure: Structure, best: Point, model: DelayModel, largest: float) -> None:
    """Refuse an order that the next lower one does without: what is left over goes into a resonance of the noise."""
    lower = replace(structure, order=structure.order - 1)
    whitening = model.whitening
    for candidate in search(data, lower, max_delay_s=largest):
        limit = min(max(1.25 * candidate.point.h, model.delay_s) + 2.0 * abs(model.a[-1] / model.a[-2]), largest)
        usable = data.usable_from(limit)
        if usable.ty.size < 3 * structure.parameters:
            continue
        start = solve_linear(usable, lower, candidate.point.a, candidate.point.h, whitening)
        fitted = minimise(usable, lower, start, max_delay_s=limit, whitening=whitening, tolerance=0.1)
        full = solve_linear(usable, structure, best.a, best.h, whitening)
        rise = (fitted.cost - full.cost) / model.noise_sd**2
        if rise < _NEEDED * np.log(usable.ty.size):
            raise IdentificationError(
                f"the record does not determine order {structure.order}: order {lower.order} with a delay of "
                f"{fitted.h:.3g} s explains it as well",
                where=data.name,
                remedy=f"ask for --order {lower.order}, move u further and faster, or record relay cycles at two more "
                "inserted delays",
            )


def _refusal_of_order(data: DelayData, model: DelayModel, largest: float, why: str) -> IdentificationError:
    period = input_period(data)
    n = model.order
    excites = "" if np.isnan(period) else f"; u repeats every {period:.3g} s and excites few frequencies"
    return IdentificationError(
        f"the record does not determine order {n}: {why} (b = {model.b:.3g}, "
        f"delay {model.delay_s:.3g} +- {1.96 * model.standard_deviations[n + 1]:.2g} s of at most {largest:.4g} s)"
        f"{excites}",
        where=data.name,
        remedy="ask for a lower order, move u further, or add a step or relay cycles at two more inserted delays; "
        "where the delay may be longer, give --max-delay and a longer record",
    )


def _too_short(data: DelayData, structure: Structure) -> IdentificationError:
    return IdentificationError(
        f"too few rows of y after the delay for {structure.parameters} parameters",
        where=data.name,
        remedy="record longer than the delay, or say what u was before the record (--past-input)",
    )
