"""Columns that are not what the model takes them for: the sign of u reversed, u and y exchanged."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from autotune.arrays import BoolArray
from autotune.diagnosis.evidence.held_out import FitQuality
from autotune.diagnosis.evidence.samples import inspect
from autotune.diagnosis.fitting.fit import RUNAWAY
from autotune.diagnosis.thresholds import Thresholds
from autotune.effects import KINDS
from autotune.recording import Recording

#: Effects that another reading of the columns is not given: all but those that make y come later.
BUT_LATE = frozenset(KINDS) - {"actuator.lag", "sensor.lag", "timing.dead_time"}


def misread_columns(
    recordings: Sequence[Recording],
    centre: float,
    quality: FitQuality,
    limits: Thresholds,
    read: Callable[[Sequence[Recording], Sequence[BoolArray]], tuple[float, bool]],
) -> str:
    """Say what is wrong with the columns, where a model without further physics then explains the recordings.

    Parameters
    ----------
    recordings : sequence of Recording
        What was measured.
    centre : float
        Command that the model takes for none.
    quality : FitQuality
        Errors of the model with the recordings as they are.
    limits : Thresholds
        What decides.
    read : callable
        Returns the held-out error of the model, retuned to other recordings of whose rows some count and late where
        that explains more, as a share of the spread of y, and whether it errs more with commands that stand still.

    Returns
    -------
    str
        A sentence; empty where the columns are not to blame.

    Notes
    -----
    It is asked only where the retuned model explains less than half of what y does, and it is said only where the
    other reading leaves less than half of that variance, and no more than effects do: an effect costs numbers, a
    reversed sign none. Columns of noise are no better read otherwise: the model then follows the command, too. A model
    of the wrong sign may lack a dead time as well, in place of which effects follow y the wrong way round: so read, it
    is given a lag or a dead time. So are the columns as they are, beside which it must be better: half a period of a
    regular command is a reversed sign as well as a dead time.
    """
    if 2.0 * quality.retuned**2 < 1.0:
        return ""
    as_they_are: float | None = None  # a search of its own, asked for once where a reading explains
    for what, changed in _readings(recordings, centre):
        error = _error_of(read, changed, limits)
        explains = 2.0 * error**2 < min(1.0, quality.retuned**2)
        if not explains or error >= (1.0 + limits.material) * quality.extended:
            continue
        as_they_are = _error_of(read, recordings, limits) if as_they_are is None else as_they_are
        if error < (1.0 - limits.material) * as_they_are:
            return (
                f"First of all, {what}: so read, the retuned simulation, with a dead time where it lacks one, errs by"
                f" {error:.3g} of the spread of y on rows that were left out, as they are by {quality.retuned:.3g}."
            )
    return ""


def _readings(recordings: Sequence[Recording], centre: float) -> Iterator[tuple[str, list[Recording]]]:
    """Yield other readings of the columns with what they would mean; equations may not say what they take for none."""
    commands = np.concatenate([r.u for r in recordings])
    middle = float(np.mean(commands))
    for about in (centre, middle)[: 1 + (abs(middle - centre) > float(np.std(commands)))]:
        yield (
            "the sign of u, or of the model's gain, is reversed",
            [replace(r, u=2.0 * about - r.u) for r in recordings],
        )
    yield "the columns u and y are exchanged", [replace(r, u=r.y, y=r.u) for r in recordings]


def _error_of(
    read: Callable[[Sequence[Recording], Sequence[BoolArray]], tuple[float, bool]],
    recordings: Sequence[Recording],
    limits: Thresholds,
) -> float:
    """Return the error of a reading; infinite where it is none, or follows no command."""
    try:
        good, _ = inspect(recordings, (), limits)
        if not all(ok.any() for ok in good):  # a command that never moves is no reading
            return math.inf
        error, heeds = read(recordings, good)
    except RUNAWAY:
        return math.inf
    return error if heeds else math.inf
