"""Whether y has anything to do with u: the question before every fit, since a fit always finds something.

Where y ran on by itself, what its own past does not foretell of it is white, and no past command can foretell it
either. So y and u are each whitened by their own past, and the innovations of y are compared with those of u, alone and
summed over 2, 4, ..., 256 rows, at all lags up to a quarter of the record. Only lags at which u came first count: what
a controller makes of y follows y, and a loop that its own noise alone drives says nothing of the plant.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, ndtr

from autotune.arrays import FloatArray, is_constant
from autotune.errors import IdentificationError
from autotune.identification.lines import chance_of_lines, find_lines, without_lines
from autotune.recording import Recording

#: A probability below this is no chance.
CHANCE = 1e-3
#: More rows are averaged; a smooth input, held linearly, needs fewer.
_MOST_ROWS, _MOST_SMOOTH_ROWS = 16384, 4096
_ORDERS = (1, 2, 4, 8, 16, 32)
_LEAST_ROWS = 20
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
#: By so much later than it does y may seem to answer: whitening smears.
_SMEARED = 2.0
#: One column is a copy of the other, in another unit, where less than this part of its spread is left.
_COPY = 1e-6


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


def recorded_dependence(recording: Recording) -> Dependence:
    """Return how likely chance alone relates y so closely to u, or to a set-point that moves and acts by way of u."""
    found = _of_columns(recording)
    r = _moving_setpoint(recording)
    if found.answers or r is None:
        return found
    by_setpoint = dependence(r, recording.y, fed_back=False)
    return replace(by_setpoint, backward=found.backward, same_row=found.same_row, sign=found.sign)


def is_fed_back(recording: Recording) -> bool:
    """Return whether a controller makes u of y: a set-point moves, or u follows y within its row."""
    return _moving_setpoint(recording) is not None or follows_in_row(recording)


def follows_in_row(recording: Recording) -> bool:
    """Return whether u follows y within its row, as what a controller makes of y does."""
    return _of_columns(recording).follows_in_row


def latest_answer_s(recording: Recording) -> float | None:
    """Return the time within which y answers a command that a controller makes of it [s], None where that is not seen.

    A dead time that is longer contradicts the record. In a loop that hardly anything but its own noise moves, a plant
    of the other sign, dead for several periods of the loop, fits about as well as the true one: it is 1/C, delayed.
    """
    if _moving_setpoint(recording) is not None:
        return None
    found = _of_columns(recording)
    if not found.follows_in_row or not found.answers:
        return None
    return _SMEARED * found.within * recording.sample_time_s


def _of_columns(recording: Recording) -> Dependence:
    return dependence(recording.u, recording.y, first_lag=0 if recording.metadata.get("hold") == "linear" else 1)


def _moving_setpoint(recording: Recording) -> FloatArray | None:
    """Return r, its gaps bridged, where it was recorded and moves."""
    if (r := recording.extra.get("r")) is None:
        return None
    bridged = _bridge(r)
    return None if is_constant(bridged) else bridged


def require_order(recordings: Sequence[Recording]) -> None:
    """Refuse recordings whose u answers y, within no row as a controller does, while y does not answer u.

    Parameters
    ----------
    recordings : sequence of Recording
        Of one loop, at least one.

    Raises
    ------
    IdentificationError
        u and y seem swapped.

    Notes
    -----
    Weaker than :func:`require_answer`: a loop that nothing but its own noise drives passes.
    """
    moving = _moving(recordings)
    found = [recorded_dependence(recording) for recording in moving]
    answers = any(one.answers for one in found) or any(map(_answers_a_test, moving, found))
    if found and not answers and _seem_swapped(found):
        raise _refusal_of_swapped(recordings)


def only_follows(recordings: Sequence[Recording]) -> bool:
    """Return whether u does nothing but follow y, as a controller does that nobody disturbs.

    Parameters
    ----------
    recordings : sequence of Recording
        Of one plant, at least one.

    Notes
    -----
    Of a linear plant such recordings say nothing: any that is 1/C, delayed, fits about as well as the true one.
    """
    moving = _moving(recordings)
    found = [recorded_dependence(recording) for recording in moving]
    return bool(found) and not _answer(moving, found) and _in_row(found)


def _moving(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings whose u moves."""
    return [recording for recording in recordings if not is_constant(_bridge(recording.u))]


def _answer(moving: Sequence[Recording], found: Sequence[Dependence]) -> bool:
    """Return whether y answers u in one of the recordings, beyond what chance finds in so many."""
    return min(one.forward for one in found) * len(found) < CHANCE or any(map(_answers_a_test, moving, found))


def _in_row(found: Sequence[Dependence]) -> bool:
    return any(one.follows_in_row for one in found)


def _seem_swapped(found: Sequence[Dependence]) -> bool:
    return min(one.backward for one in found) * len(found) < CHANCE and not _in_row(found)


def _refusal_of_swapped(recordings: Sequence[Recording]) -> IdentificationError:
    return IdentificationError(
        "u and y seem swapped: u answers y, and y does not answer u",
        where=", ".join(recording.name for recording in recordings),
        remedy="name the columns the other way round with --u and --y",
    )


def require_answer(recordings: Sequence[Recording]) -> None:
    """Refuse recordings in which y has nothing to do with u, and those whose columns say something else.

    Parameters
    ----------
    recordings : sequence of Recording
        Of one plant, at least one; it is enough if y answers in one of them.

    Raises
    ------
    IdentificationError
        Too few rows to tell, u never changes, y is a copy of u, the two are swapped, u does nothing but follow y, or y
        does not answer u beyond chance (1 in 1,000).
    """
    if (most := max(map(len, recordings))) < _LEAST_ROWS:
        raise IdentificationError(
            f"{most} rows are too few to tell whether y answers u", where=recordings[0].name,
            remedy=f"record for longer: {_LEAST_ROWS} rows at least",
        )  # fmt: skip
    moving = _moving(recordings)
    if not moving:
        raise IdentificationError(
            "u is constant: the command never changes",
            where=recordings[0].name,
            remedy="record an experiment that moves u",
        )
    for recording in moving:
        if len(recording) >= _LEAST_ROWS:
            require_two_signals(recording)
    found = [recorded_dependence(recording) for recording in moving]
    if _answer(moving, found):
        return
    where = ", ".join(recording.name for recording in recordings)
    if _seem_swapped(found):
        raise _refusal_of_swapped(recordings)
    if _in_row(found):
        raise IdentificationError(
            "u does nothing but follow y, as a controller does that nobody disturbs: this says nothing of the plant, "
            "unless u and y are swapped",
            where=where, remedy="record a set-point or a dither that moves the loop, or steps of u in open loop",
        )  # fmt: skip
    raise IdentificationError(
        f"y has nothing to do with u beyond chance: noise alone does as much with a probability of "
        f"{min(one.forward for one in found):.2g}, and at most {CHANCE:g} is accepted",
        where=where, remedy="check the columns; record larger or longer moves of u, after some rest",
    )  # fmt: skip


def _answers_a_test(recording: Recording, found: Dependence) -> bool:
    """Return whether y answers a few steps or ramps as a plant does, beyond what any colour of noise explains."""
    from autotune.identification.plant_evidence import NEEDED, is_simple_test, plant_evidence

    if found.follows_in_row or not is_simple_test(_bridge(recording.u)):
        return False
    return plant_evidence(recording) > NEEDED


def require_two_signals(recording: Recording) -> None:
    """Refuse a recording whose y is a copy of u, in another unit or with another zero.

    Raises
    ------
    IdentificationError
        It is one, to a millionth of its spread in every row.
    """
    u, y = _bridge(recording.u), _bridge(recording.y)
    v, w = u - u.mean(), y - y.mean()
    apart = w - (float(v @ w) / max(float(v @ v), 1e-300)) * v
    if not is_constant(y) and not is_constant(u) and float(np.linalg.norm(apart)) <= _COPY * float(np.linalg.norm(w)):
        raise IdentificationError(
            "y is u, in every row, up to unit and offset: one signal under two names",
            where=recording.name,
            remedy="name the column of the measurement with --y",
        )


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
    u, y, first, every = _thin(_bridge(u), _bridge(y), first_lag)
    if min(u.size, y.size) < _LEAST_ROWS or is_constant(u) or is_constant(y):
        return Dependence(forward=1.0, backward=1.0, same_row=0.0, lag=0, sign=1, within=0)
    found = _by_innovations(u, y, first, fed_back)
    if not found.answers or _is_foretold(_innovations(y, _ROUNDING), y):
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


def _by_innovations(u: FloatArray, y: FloatArray, first: int, fed_back: bool) -> Dependence:
    """Return how surely what is new in y comes from what was new in u, and the other way round."""
    e_u, e_y = _innovations(u, _COMMAND), _innovations(y, _ROUNDING)
    forward, lag, sign, within = _closest(_own_moves(u, y, e_u) if first and fed_back else e_u, e_y, first)
    backward, *_ = _closest(_innovations(y, _COMMAND), _innovations(u, _ROUNDING), 1)
    backward = 1.0 if _are_waves(e_u, u) else backward
    size = float(np.linalg.norm(e_u) * np.linalg.norm(e_y))
    same = float(e_u @ e_y) / size * math.sqrt(e_u.size) if size > 0.0 and first else 0.0
    # a controller's gain has the sign that turns the plant's answer back, where there is an answer
    if forward < CHANCE and lag == first and sign == np.sign(same):
        same = 0.0
    return Dependence(forward=forward, backward=backward, same_row=same, lag=lag, sign=sign, within=within)


def _bridge(values: FloatArray) -> FloatArray:
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
