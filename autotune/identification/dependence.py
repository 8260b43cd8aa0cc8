"""Whether one signal has anything to do with another: what is new in each, compared in order of time.

Where y ran on by itself, what its own past does not foretell of it is white, and no past command can foretell it
either. So y and u are each whitened by their own past, and the innovations of y are compared with those of u, alone and
summed over 2, 4, ..., 256 rows, at all lags up to a quarter of the record. Only lags at which u came first count: what
a controller makes of y follows y, and a loop that its own noise alone drives says nothing of the plant.
No row of sines is new: whether y answers those is asked of its lines, and of what they leave.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, ndtr

from autotune.arrays import FloatArray, is_constant
from autotune.identification.lines import chance_of_lines, find_lines, without_lines

#: A probability below this is no chance.
CHANCE = 1e-3
#: More rows are averaged; a smooth input, held linearly, needs fewer.
_MOST_ROWS, _MOST_SMOOTH_ROWS = 16384, 4096
_ORDERS = (1, 2, 4, 8, 16, 32)
#: Fewer rows tell nothing.
LEAST_ROWS = 20
#: Beyond so many standard deviations the innovations of one row belong together.
_SAME_ROW = 4.0
#: The spread of what whitening cannot take out, over the signal's own: noise of rounding, and of commands without any.
_ROUNDING, _COMMAND = 1e-6, 1e-3
#: u is fed back where y foretells more than half of its innovations' variance, and nothing but that where this is left.
_FEEDBACK, _LEAST_OWN = 0.7, 3e-4
_LEAST_RIDGE = 1e-10
#: Rows within which a controller answers, its computer's delay included.
_SOON = 8
#: Innovations that are less than this part of a signal's spread may be what its waves leave, and no noise.
_FORETOLD = 0.05
#: Of the cause's energy, so much has to be left at a lag.
_LEAST_ENERGY = 0.05


@dataclass(frozen=True, kw_only=True)
class Dependence:
    """How likely chance alone would give so close a relation.

    Attributes
    ----------
    forward : float
        Of y to what u was in earlier rows.
    backward : float
        Of u to what y was in earlier rows: a feedback, or a swapped pair.
    same_row : float
        Of the two innovations in one row, in standard deviations: a controller's, since y is measured before u acts; 0
        where u acted before, as ``first_lag`` 0 says or y, which answers in the next row with the same sign.
    lag : int
        Rows by which u came first where the relation forward is closest.
    sign : {1, -1}
        Sign of that relation.
    within : int
        Rows within which y answers by that relation: the lag, and the rows that were summed.
    """

    forward: float
    backward: float
    same_row: float
    lag: int
    sign: int
    within: int

    @property
    def answers(self) -> bool:
        """Whether y answers u, beyond chance."""
        return self.forward < CHANCE

    @property
    def follows_in_row(self) -> bool:
        """Whether u follows y within its row, as what a controller makes of y does."""
        return abs(self.same_row) > _SAME_ROW


def dependence(u: FloatArray, y: FloatArray, *, first_lag: int = 1, fed_back: bool = True) -> Dependence:
    """Return how likely chance alone relates two signals so closely.

    Parameters
    ----------
    u, y : array, shape (n,)
        Rows in order of time; NaN is bridged.
    first_lag : int
        Least number of rows by which u comes first; 0 where ``u`` is a prediction of ``y``.
    fed_back : bool
        Whether u may be what a controller makes of y; not of a set-point.

    Returns
    -------
    Dependence
        Probabilities are bounds (Bonferroni over lags and sums).

    Notes
    -----
    The closest relation is judged without the one product that adds most to it: a single jump of y may follow a single
    step of u by chance. Linear: a y that
    answers to both signs of u alike is not seen to answer.

    References
    ----------
    Haugh, Checking the independence of two covariance-stationary time series, JASA 71, 1976.
    """
    u, y, first, every = _thin(bridge(u), bridge(y), first_lag)
    if min(u.size, y.size) < LEAST_ROWS or is_constant(u) or is_constant(y):
        return Dependence(forward=1.0, backward=1.0, same_row=0.0, lag=0, sign=1, within=0)
    e_y = _innovations(y, _ROUNDING)
    found = _by_innovations(u, y, e_y, first, fed_back)
    if not found.answers or _is_foretold(e_y, y):
        found = _by_lines(u, y, found, first, fed_back)
    return replace(found, lag=found.lag * every, within=found.within * every)


def _is_foretold(innovations: FloatArray, x: FloatArray) -> bool:
    return float(np.std(innovations)) < _FORETOLD * float(np.std(x))


def _are_waves(innovations: FloatArray, x: FloatArray) -> bool:
    """Return whether innovations are waves that an autoregression has left: no chance of white noise holds for them.

    References
    ----------
    Fisher, Tests of significance in harmonic analysis, Proc. R. Soc. A 125, 1929: the largest line beside all of them.
    """
    if not _is_foretold(innovations, x):
        return False
    lines = np.abs(np.fft.rfft(innovations)[1:]) ** 2
    total = float(np.sum(lines))
    share = float(np.max(lines)) / total if total > 0.0 else 1.0
    return bool(lines.size * (1.0 - share) ** (lines.size - 1) < CHANCE)


def _by_lines(u: FloatArray, y: FloatArray, found: Dependence, first: int, fed_back: bool) -> Dependence:
    """Return how surely y answers the sines that u is, or u those of y, beside which no row is news."""
    of_u, of_y = find_lines(u), find_lines(y)
    if not (of_u.size or of_y.size):
        return found
    lines = of_u if of_u.size else of_y
    left_u, left_y = without_lines(u, lines), without_lines(y, lines)
    no_more_u = float(np.std(left_u)) <= _COMMAND * float(np.std(u))
    no_more_y = float(np.std(left_y)) <= _COMMAND * float(np.std(y))
    follows = 0.0 if no_more_u or no_more_y or not (first and fed_back) else _within_rows(left_y, left_u)
    beside = replace(found, forward=1.0, backward=1.0, same_row=follows, lag=first, within=u.size // 4)
    # an effect carries what its cause does beside the lines
    if of_u.size and not beside.follows_in_row and (no_more_u or not no_more_y):
        return replace(beside, forward=_chance_of_lines(y, left_y, of_u))
    if of_y.size and no_more_y and not no_more_u:
        return replace(beside, backward=_chance_of_lines(u, left_u, of_y))
    return beside


def _within_rows(cause: FloatArray, effect: FloatArray) -> float:
    """Return the closest relation of innovations of an effect to those of its cause up to 8 rows before, in sd."""
    e_cause, e_effect = _innovations(cause, _ROUNDING), _innovations(effect, _ROUNDING)
    products = [float(e_cause[: e_cause.size - k] @ e_effect[k:]) for k in range(_SOON + 1)]
    size = float(np.linalg.norm(e_cause) * np.linalg.norm(e_effect)) / math.sqrt(cause.size)
    return max(products, key=abs) / size


def _chance_of_lines(x: FloatArray, left: FloatArray, lines: FloatArray) -> float:
    """Return how likely noise of the colour of what lines leave of a signal has as large a line as it."""
    weights, _ = _autoregression(left, _ROUNDING)
    x = x - x.mean()
    return chance_of_lines(x[weights.size :] - _past(x, weights.size) @ weights, lines)


def _by_innovations(u: FloatArray, y: FloatArray, e_y: FloatArray, first: int, fed_back: bool) -> Dependence:
    """Return how surely what is new in y, e_y, comes from what was new in u, and the other way round."""
    e_u = _innovations(u, _COMMAND)
    forward, lag, sign, within = _closest(_own_moves(u, y, e_u) if first and fed_back else e_u, e_y, first)
    backward, *_ = _closest(_innovations(y, _COMMAND), _innovations(u, _ROUNDING), 1)
    backward = 1.0 if _are_waves(e_u, u) else backward
    size = float(np.linalg.norm(e_u) * np.linalg.norm(e_y))
    same = float(e_u @ e_y) / size * math.sqrt(e_u.size) if size > 0.0 and first else 0.0
    # a controller's gain has the sign that turns the plant's answer back, where there is an answer
    if forward < CHANCE and lag == first and sign == np.sign(same):
        same = 0.0
    return Dependence(forward=forward, backward=backward, same_row=same, lag=lag, sign=sign, within=within)


def bridge(values: FloatArray) -> FloatArray:
    """Return a signal whose gaps are straight lines; 0 where it has no row.

    Parameters
    ----------
    values : (N,) array
        NaN where there is none.
    """
    known = np.isfinite(values)
    if known.all() or not known.any():
        return np.where(known, values, 0.0)
    rows = np.arange(values.size)
    return np.asarray(np.interp(rows, rows[known], values[known]))


def _own_moves(u: FloatArray, y: FloatArray, e_u: FloatArray) -> FloatArray:
    """Return the innovations of u, without what y foretells where that is much: what a controller did not make of y.

    The row's own y counts, since a controller saw it before it gave u.
    """
    most = max(order for order in _ORDERS if order <= u.size // 16)
    v, y = (u - u.mean()) / np.std(u), (y - y.mean()) / np.std(y)
    seen = np.column_stack([_past(v, most), y[most:], _past(y, most), np.ones(u.size - most)])
    gram = seen.T @ seen + _LEAST_RIDGE * seen.shape[0] * np.eye(seen.shape[1])
    own = np.zeros_like(e_u)
    own[most:] = (v[most:] - seen @ np.linalg.solve(gram, seen.T @ v[most:])) * np.std(u)
    part = float(np.linalg.norm(own) / max(float(np.linalg.norm(e_u[most:])), 1e-300))
    if part > _FEEDBACK:
        return e_u
    return own if part > _LEAST_OWN else np.zeros_like(own)


def _past(x: FloatArray, order: int) -> FloatArray:
    return np.column_stack([x[order - k : x.size - k] for k in range(1, order + 1)])


def _thin(u: FloatArray, y: FloatArray, first_lag: int) -> tuple[FloatArray, FloatArray, int, int]:
    """Return at most so many rows, the first lag, and how many each is the mean of: a row of u is before y's next."""
    every = -(-u.size // (_MOST_ROWS if first_lag else _MOST_SMOOTH_ROWS))
    if every <= 1:
        return u, y, first_lag, 1
    rows = u.size // every * every
    return u[:rows].reshape(-1, every).mean(axis=1), y[:rows].reshape(-1, every).mean(axis=1), first_lag, every


def _innovations(x: FloatArray, floor: float) -> FloatArray:
    """Return what an autoregression leaves, with noise of so much of x's spread; 0 in the first rows."""
    x = x - x.mean()
    weights, level = _autoregression(x, floor)
    return np.concatenate([np.zeros(weights.size), x[weights.size :] - _past(x, weights.size) @ weights - level])


def _autoregression(x: FloatArray, floor: float) -> tuple[FloatArray, float]:
    """Return the weights of the last rows that foretell the next one, their number by Akaike's criterion, and a level.

    x has the mean 0.
    """
    noise = floor * float(np.std(x))
    orders = [order for order in _ORDERS if order <= x.size // 8]
    most = orders[-1]
    past = np.column_stack([_past(x, most), np.full(x.size - most, np.std(x))])
    gram, right = past.T @ past, past.T @ x[most:]
    best, found = math.inf, np.zeros(2)
    for order in orders:
        used = [*range(order), most]
        ridge = noise**2 * past.shape[0] * np.eye(order + 1)
        weights = np.linalg.solve(gram[np.ix_(used, used)] + ridge, right[used])
        left = x[most:] - past[:, used] @ weights
        criterion = left.size * math.log(float(np.mean(left**2)) + noise**2) + 2.0 * order
        if criterion < best:
            best, found = criterion, weights
    return found[:-1], float(found[-1] * np.std(x))


def _closest(cause: FloatArray, effect: FloatArray, first: int) -> tuple[float, int, int, int]:
    """Return the probability of an effect's closest relation to sums of an earlier cause, lag, sign, and lag and sum.

    Every octave of lags and every length of the sums is looked at for the same part of the error probability.
    """
    n = effect.size
    sd = float(np.sqrt(np.mean(effect[np.flatnonzero(effect)] ** 2))) if effect.any() else 0.0
    if sd == 0.0 or not cause.any():
        return 1.0, 0, 1, 0
    spectrum, total = np.fft.rfft(effect, 2 * n), np.concatenate([[0.0], np.cumsum(cause)])
    lags = np.arange(first, n // 4 + 1)
    widths = [width for width in 2 ** np.arange(9) if width <= n // 8]
    each = 2.0 * len(widths) * math.log2(2.0 * lags[-1])
    best, lag, sign, within = 1.0, 0, 1, 0
    for width in widths:
        sums = np.concatenate([np.zeros(width - 1), total[width:] - total[:-width]])
        products = np.fft.irfft(np.fft.rfft(sums, 2 * n).conj() * spectrum, 2 * n)[lags]
        energy = np.concatenate([[0.0], np.cumsum(sums**2)])
        left = energy[n - lags]
        scale = np.where(left > _LEAST_ENERGY * energy[n], sd * np.sqrt(left), math.inf)
        looks = each * np.maximum(1.0, lags / width)
        chance = np.log(looks) + log_ndtr(-np.abs(products) / scale)
        at = int(np.argmin(chance))
        pairs = sums[: n - lags[at]] * effect[lags[at] :] * np.sign(products[at])
        size = float(np.sum(pairs) - np.max(pairs)) / float(scale[at])
        found = float(min(1.0, 2.0 * ndtr(-size) * looks[at]))
        if found < best:
            best, lag, sign = found, int(lags[at]), 1 if products[at] > 0.0 else -1
            within = lag + int(width)
    return best, lag, sign, within
