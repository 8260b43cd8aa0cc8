"""Whether y of a recording answers its u, and what the columns say instead: the question before every fit.

A fit always finds something. Swapped columns, one signal under two names and a controller that nobody disturbs are each
said as such.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray, is_constant
from autotune.errors import IdentificationError
from autotune.identification.dependence import CHANCE, LEAST_ROWS, Dependence, bridge, dependence
from autotune.recording import Recording

#: By so much later than it does y may seem to answer: whitening smears.
_SMEARED = 2.0
#: One column is a copy of the other, in another unit, where less than this part of its spread is left.
_COPY = 1e-6


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
    bridged = bridge(r)
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
    return [recording for recording in recordings if not is_constant(bridge(recording.u))]


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
    if (most := max(map(len, recordings))) < LEAST_ROWS:
        raise IdentificationError(
            f"{most} rows are too few to tell whether y answers u", where=recordings[0].name,
            remedy=f"record for longer: {LEAST_ROWS} rows at least",
        )  # fmt: skip
    moving = _moving(recordings)
    if not moving:
        raise IdentificationError(
            "u is constant: the command never changes",
            where=recordings[0].name,
            remedy="record an experiment that moves u",
        )
    for recording in moving:
        if len(recording) >= LEAST_ROWS:
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

    if found.follows_in_row or not is_simple_test(bridge(recording.u)):
        return False
    return plant_evidence(recording) > NEEDED


def require_two_signals(recording: Recording) -> None:
    """Refuse a recording whose y is a copy of u, in another unit or with another zero.

    Raises
    ------
    IdentificationError
        It is one, to a millionth of its spread in every row.
    """
    u, y = bridge(recording.u), bridge(recording.y)
    v, w = u - u.mean(), y - y.mean()
    apart = w - (float(v @ w) / max(float(v @ v), 1e-300)) * v
    if not is_constant(y) and not is_constant(u) and float(np.linalg.norm(apart)) <= _COPY * float(np.linalg.norm(w)):
        raise IdentificationError(
            "y is u, in every row, up to unit and offset: one signal under two names",
            where=recording.name,
            remedy="name the column of the measurement with --y",
        )
