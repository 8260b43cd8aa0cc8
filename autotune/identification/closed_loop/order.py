"""Order and dead time of the plant: polished models of every order, compared by the Bayesian information criterion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.distributions import chi2_quantile
from autotune.errors import IdentificationError
from autotune.identification.closed_loop.prediction_error import PredictionErrorEstimate, prediction_error
from autotune.identification.closed_loop.series import Series
from autotune.identification.closed_loop.subspace_direct import (
    LaggedData,
    autoregression,
    choose_past_window,
    lagged_data,
    pbsid_states,
    regress_system,
)
from autotune.progress import Progress, quiet

#: A higher order, or a dead time, must earn this much in the criterion (strong evidence by Raftery's scale): otherwise
#: a pole that a zero nearly cancels, placed where the noise happens to have a line, would pass for dynamics.
_CLEAR_GAIN = 6.0
#: A dead time behind the best one by more than this is as good as refuted: its odds are below one in a thousand.
_REFUTED = 30.0
#: Units of the likelihood that count as one where structures are weighed: none of them is the true one to the noise.
_TEMPERATURE = 2.0
#: Dead times [rows] and orders beside them that are tried at least: the criterion may rise before it falls.
_TRIED, _ORDERS = 12, 4
#: Posterior probability below which a structure is not kept beside the chosen one.
_LEAST_WEIGHT = 1e-3
#: Accepted steps for a candidate; only the chosen one is polished to the end.
_CANDIDATE_STEPS = 25
#: Rows that the choice looks at; longer records are polished whole once it is made.
CHOICE_ROWS = 20_000
#: Rows that a start is computed from; the polish, which decides, takes them all.
_START_ROWS = 100_000
#: The past window is at most this part of a typical stretch: 1 / 5.
_SHARE_OF_STRETCH = 5
#: Residuals below this share of the signals are rounding: a higher order earns nothing by making them smaller still.
_NOISE_FREE = 1e-7


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One order and dead time that was tried.

    Attributes
    ----------
    order, delay : int
        States and whole samples of dead time.
    innovation_sd : float
        Geometric mean of the standard deviations of the residuals, in the units of the (scaled) data.
    bic : float
        Criterion, relative to the best candidate.
    """

    order: int
    delay: int
    innovation_sd: float
    bic: float


@dataclass(frozen=True, kw_only=True, eq=False)
class OrderChoice:
    """The chosen estimate and the evidence.

    Attributes
    ----------
    estimate : PredictionErrorEstimate
        Polished model of the chosen order and dead time.
    others : tuple of (float, PredictionErrorEstimate)
        Models of other orders and dead times that the record leaves open, with their posterior probabilities.
    evidence : tuple of Candidate
        Every candidate, the best first.
    """

    estimate: PredictionErrorEstimate
    others: tuple[tuple[float, PredictionErrorEstimate], ...]
    evidence: tuple[Candidate, ...]


def default_past_window(rows: int, channels: int) -> int:
    """Return the longest past window worth trying: a twentieth of the rows per channel, 4 to 60 lags.

    Parameters
    ----------
    rows : int
        Of the record.
    channels : int
        Inputs and outputs.
    """
    return int(np.clip(rows // (20 * channels), 4, 60))


def _start_and_polish(
    data: LaggedData,
    series: Series,
    order: int,
    *,
    delay: int,
    offset: bool = True,
    max_iterations: int = 60,
) -> PredictionErrorEstimate:
    """Return the polished model of one order, started by PBSIDopt on the factor ``data`` of the shifted signals."""
    f = min(data.p, max(10, -(-order // data.n_y) + 2))
    start = replace(regress_system(data, pbsid_states(data, f), order), input_delay=delay)
    return prediction_error(
        start,
        series.u,
        series.y,
        offset=offset,
        max_iterations=max_iterations,
        starts=series.starts,
    )


def choose_order(
    u: FloatArray,
    y: FloatArray,
    *,
    max_order: int = 8,
    progress: Progress = quiet,
    starts: tuple[int, ...] = (0,),
) -> OrderChoice:
    """Choose order and dead time by the Bayesian information criterion over polished models.

    Parameters
    ----------
    u, y : (N, n_u), (N, n_y) arrays
        Input and output, mean removed and scaled alike.
    max_order : int
        Highest order tried; the record's length may lower it.
    progress : callable
        Told what is tried; the share is NaN, since dead times are tried only where the data hint at one.
    starts : tuple of int
        First row of each stretch.

    Returns
    -------
    OrderChoice

    Raises
    ------
    IdentificationError
        The record is too short for order 1, or no order gave a model.

    Notes
    -----
    Consistent as the record grows; on a short record a mode that the data do not show is left out. A higher order, or a
    dead time, is named only where it earns a clear gain. What is not clear stays among the others, weighed by
    exp(-c / 4), c the criterion of Hannan & Quinn (J. R. Statist. Soc. B 41, 1979), the least that a number must pay in
    a consistent choice: the Bayesian one believes in few numbers too much to say what else may be.
    """
    series = Series(u=u, y=y, starts=starts)
    few = series.head(CHOICE_ROWS)
    cut, n_u, n_y = len(few), u.shape[1], y.shape[1]
    data = _factor(few)
    fits: dict[tuple[int, int], PredictionErrorEstimate] = {}

    def try_order(order: int, delay: int, factor: LaggedData) -> None:
        progress(f"order {order}, dead time {delay}", math.nan)
        try:
            fits[order, delay] = _start_and_polish(factor, few, order, delay=delay, max_iterations=_CANDIDATE_STEPS)
        except IdentificationError:
            return  # a candidate that has no model is no candidate

    highest = min(max_order, data.p * (n_u + n_y) // 2, (cut // 4) // (n_u + 2 * n_y))
    for order in range(1, highest + 1):
        try_order(order, 0, data)
    if not fits:
        raise IdentificationError(
            f"no model of order 1 to {max(highest, 1)} could be fitted to {cut} rows",
            remedy="record longer and excite the loop more",
        )
    most, hinted = min(max(_parsimonious(fits)[0] + 1, _ORDERS), highest), _dead_time(data, cut)
    for delay in range(1, data.p):
        factor = _factor(few.delayed(delay), p=data.p)
        for order in range(1, most + 1):
            try_order(order, delay, factor)
        if delay >= max(hinted, _TRIED) and _is_refuted(fits, delay):
            break
    best = _parsimonious(fits)
    evidence = _evidence(fits)
    factor = _factor(series.head(_START_ROWS).delayed(best[1]), p=data.p)
    estimate = fits[best]
    if cut < len(u) or not estimate.converged:
        estimate = _start_and_polish(factor, series, best[0], delay=best[1])
    return OrderChoice(estimate=estimate, others=_others(fits, best), evidence=evidence)


def fit_order(
    u: FloatArray,
    y: FloatArray,
    order: int,
    *,
    delay: int = 0,
    p: int | None = None,
    offset: bool = True,
    starts: tuple[int, ...] = (0,),
) -> PredictionErrorEstimate:
    """Return the polished model of a given order and dead time: PBSIDopt start, then prediction error.

    Parameters
    ----------
    u, y : (N, n_u), (N, n_y) arrays
        Input and output.
    order, delay : int
        States, and whole samples of dead time.
    p : int, optional
        Past window of the start; chosen by Akaike's criterion when absent.
    offset : bool
        As in :func:`autotune.identification.closed_loop.prediction_error.prediction_error`.
    starts : tuple of int
        First row of each stretch of equidistant rows.
    """
    series = Series(u=u, y=y, starts=starts)
    factor = _factor(series.head(_START_ROWS).delayed(delay), p=p, least=order + 2)
    return _start_and_polish(factor, series, order, delay=delay, offset=offset)


def _factor(series: Series, p: int | None = None, least: int = 10) -> LaggedData:
    u, y, starts = series.u, series.y, series.starts
    if p is not None:
        return lagged_data(u, y, p, starts)
    longest = default_past_window(len(u), u.shape[1] + y.shape[1])
    if series.is_cut:  # a past as long as a stretch would leave nothing of it
        typical = int(np.median([rows.stop - rows.start for rows in series.slices]))
        longest = max(min(longest, typical // _SHARE_OF_STRETCH), 4)
    data = lagged_data(u, y, longest, starts)
    wanted = max(choose_past_window(data), least)
    return data if wanted >= data.p else data.window(wanted)


def _dead_time(data: LaggedData, rows: int) -> int:
    """Return how many first impulse-response terms the long autoregression cannot tell from zero (99 %).

    Biased where a loop is hardly excited: it says how far dead times are tried at least.
    """
    past, now_y = data.past(), data.now[1]
    residuals = data.R[past.stop :, now_y]
    variance = residuals.T @ residuals / max(rows - past.stop, 1)
    factor = data.R[past, past]
    scale = np.abs(np.diag(factor))
    if np.min(scale) <= 1e-9 * np.max(scale):
        return 0
    inverse = np.linalg.inv(factor)
    phi = autoregression(data)
    n_u, n_z, n_y = data.n_u, data.n_u + data.n_y, data.n_y
    count = 0
    for k in range(1, data.p - 1):
        at = np.concatenate([np.arange(i * n_z, i * n_z + n_u) for i in range(k)])
        spread = inverse[at] @ inverse[at].T
        terms = np.concatenate([phi[i, :, :n_u].T for i in range(k)])  # (k n_u, n_y)
        statistic = float(np.trace(np.linalg.solve(spread, terms) @ np.linalg.solve(variance, terms.T)))
        if statistic > chi2_quantile(0.99, k * n_u * n_y):
            break
        count = k
    return count if count < data.p - 2 else 0


def _parsimonious(fits: dict[tuple[int, int], PredictionErrorEstimate]) -> tuple[int, int]:
    criterion = _criteria(fits)
    lowest = min(value for (_, delay), value in criterion.items() if delay == 0)
    prompt = min(key for key, value in criterion.items() if key[1] == 0 and value < lowest + _CLEAR_GAIN)
    late = [key for key in fits if key[1] > 0]
    if not late:
        return prompt
    best_late = min(late, key=lambda key: criterion[key])
    return best_late if criterion[prompt] - criterion[best_late] > _CLEAR_GAIN else prompt


def _criteria(fits: dict[tuple[int, int], PredictionErrorEstimate]) -> dict[tuple[int, int], float]:
    """Return the criterion of every candidate, as if from as many rows, relative to the best one."""
    rows = min(estimate.rows for estimate in fits.values())
    criterion = {key: _per_rows(fit, rows) for key, fit in fits.items()}
    lowest = min(criterion.values())
    return {key: value - lowest for key, value in criterion.items()}


def _is_refuted(fits: dict[tuple[int, int], PredictionErrorEstimate], delay: int) -> bool:
    """Whether no order explains the data with a dead time."""
    return min((value for key, value in _criteria(fits).items() if key[1] == delay), default=math.inf) > _REFUTED


def _others(
    fits: dict[tuple[int, int], PredictionErrorEstimate], chosen: tuple[int, int]
) -> tuple[tuple[float, PredictionErrorEstimate], ...]:
    """Return the structures that the data leave open beside the chosen one, with their weights of all."""
    rows = min(estimate.rows for estimate in fits.values())
    criteria = {key: _per_rows(fit, rows, 2.0 * math.log(math.log(rows))) for key, fit in fits.items()}
    lowest = min(criteria.values())
    weights = {key: math.exp(-0.5 * (value - lowest) / _TEMPERATURE) for key, value in criteria.items()}
    total = sum(weights.values())
    kept = [(w / total, key) for key, w in weights.items() if key != chosen and w > _LEAST_WEIGHT * total]
    return tuple((weight, fits[key]) for weight, key in kept)


def _per_rows(estimate: PredictionErrorEstimate, rows: int, charge: float | None = None) -> float:
    """Return the criterion as if from ``rows`` rows: candidates with a dead time use a few rows fewer.

    Each number pays a charge, log rows by default.
    """
    floor = 2.0 * estimate.model.C.shape[0] * float(np.log(_NOISE_FREE))
    paid = estimate.bic - estimate.rows * estimate.log_det
    share = 1.0 if charge is None else charge / math.log(estimate.rows)
    return float(rows * max(estimate.log_det, floor) + share * paid)


def _evidence(fits: dict[tuple[int, int], PredictionErrorEstimate]) -> tuple[Candidate, ...]:
    criterion = _criteria(fits)
    candidates = [
        Candidate(
            order=order,
            delay=delay,
            innovation_sd=float(np.exp(0.5 * fit.log_det / fit.model.C.shape[0])),
            bic=criterion[order, delay],
        )
        for (order, delay), fit in fits.items()
    ]
    return tuple(sorted(candidates, key=lambda candidate: candidate.bic))
