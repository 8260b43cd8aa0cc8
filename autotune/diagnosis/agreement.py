"""How often another campaign on this rig would say the same: its hypotheses, judged on parts of the recordings.

A search among a hundred effects always finds the one that suits these rows best, and a likelihood of these rows is sure
of it. Whether the rig or these rows chose it shows on other rows: each part leaves a fifth of every recording out, and
what was found on all of them is fitted and judged there. What another physics explains as well changes its name from
part to part.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from autotune.diagnosis.thresholds import IN_USE, Thresholds
from autotune.recording import Recording

#: Share of every recording that a part leaves out, at its beginning or at its end.
LEFT_OUT = 0.2
#: Probability, as a mean over all rows and the parts, from which on an effect is likelier than not.
NAMED = 0.5
#: Probability at least of an effect in a part: no search of some rows rules an effect out.
LEAST = 0.01


def likely(said: Mapping[str, float]) -> frozenset[str]:
    """Return the effects that are likelier than not."""
    return frozenset(name for name, probability in said.items() if probability >= NAMED)


#: When effects begin: recording and time [s].
Begins: TypeAlias = Mapping[str, Sequence[tuple[int, float]]]


#: Recordings with a share of their rows left out.
Part: TypeAlias = tuple[Recording, ...]


def parts_of(recordings: Sequence[Recording], least_rows: int) -> tuple[Part, ...]:
    """Return the recordings without the readings of their first fifth, and without their last fifth.

    What was commanded in the first fifth stays: a play, a dead time or a swinging load bring it along, and times count
    from the same row.

    Parameters
    ----------
    recordings : sequence of Recording
        What was measured.
    least_rows : int
        Rows that a diagnosis needs; where a part of a recording has fewer than twice that there are no parts.
    """
    if any((1.0 - LEFT_OUT) * np.isfinite(r.y).sum() < 2 * least_rows for r in recordings):
        return ()
    later = tuple(r.read_from(int(LEFT_OUT * len(r))) for r in recordings)
    return later, tuple(r.only(slice(int((1.0 - LEFT_OUT) * len(r)))) for r in recordings)


def tells(part: Part, began: Sequence[tuple[int, float]]) -> bool:
    """Whether an effect that begins at given times, if any, begins in a part: else no change is seen there."""
    return not began or any(part[i].t[part[i].first_reading] < start < part[i].t[-1] for i, start in began)


def agreement(
    whole: Mapping[str, float],
    begins: Begins,
    parts: Sequence[Part],
    said: Sequence[Mapping[str, float]],
    least: float = NAMED,
    limits: Thresholds = IN_USE,
) -> Mapping[str, float]:
    """Return the effects that are likelier than not, with their probabilities.

    Parameters
    ----------
    whole : mapping of str to float
        Probabilities of effects by the whole recordings, all hypotheses counted that have them.
    begins : mapping of str to sequence of (int, float)
        When effects begin, where they do not act from the first row on.
    parts : sequence of Part
        On which it was judged again.
    said : sequence of mapping of str to float
        Probabilities by each part, NaN of an effect that it cannot tell.
    least : float
        Probability from which on an effect is returned.
    limits : Thresholds
        What decides between two findings.

    Returns
    -------
    mapping of str to float
        The geometric mean over all rows and the parts that tell of an effect, where it is at least so much: what a part
        contradicts is not named, however sure the others are. What every part confirms has its odds in full.

    Notes
    -----
    One search is cooled, for its likelihood of these rows is too sure (``temperature``). Whether other rows say the
    same is what the parts were asked: what is likelier than not by all of them is stated with its odds in full, so that
    the same effects are named. What one of them cannot tell, as a step before it begins, stays as open as it was: the
    other one has four fifths of the same rows.

    References
    ----------
    Meinshausen and Buhlmann, J. R. Statist. Soc. B 72, 2010: stability selection; Genest and Zidek, Statist. Sci. 1,
    1986: the logarithmic pool of probabilities.
    """
    agreed = {}
    for name in whole:
        all_said = [whole, *(one for part, one in zip(parts, said, strict=True) if tells(part, begins.get(name, ())))]
        told = [max(p, LEAST) for p in (one.get(name, 0.0) for one in all_said) if not math.isnan(p)]
        mean = float(np.exp(np.mean(np.log(told))))
        probability = undo_cooling(mean, limits) if mean >= NAMED and 1 < len(told) > len(parts) else mean
        if probability >= least:
            agreed[name] = probability
    return agreed


def undo_cooling(probability: float, limits: Thresholds) -> float:
    """Return a probability with the odds that it would have had no search been cooled, outside causes allowed for.

    Parameters
    ----------
    probability : float
        As a search states it.
    limits : Thresholds
        How far a search is cooled, and the prior odds of a cause outside the catalogue.
    """
    most = 1.0 / (1.0 + limits.unknown_odds)
    if probability >= most:
        return probability
    odds = (probability / (1.0 - probability)) ** limits.temperature
    return float(min(odds / (1.0 + odds), most))
