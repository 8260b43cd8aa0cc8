"""Columns that are not what the model takes them for: the sign of u reversed, u and y exchanged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from autotune.arrays import BoolArray
from autotune.diagnosis.evidence.held_out import FitQuality
from autotune.diagnosis.evidence.samples import inspect
from autotune.diagnosis.fitting.fit import RUNAWAY
from autotune.diagnosis.thresholds import Thresholds
from autotune.recording import Recording


def misread_columns(
    recordings: Sequence[Recording],
    centre: float,
    quality: FitQuality,
    limits: Thresholds,
    retuned: Callable[[Sequence[Recording], Sequence[BoolArray]], tuple[float, bool]],
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
    retuned : callable
        Returns the held-out error of the model, retuned to other recordings of whose rows some count, as a share of the
        spread of y, and whether it errs more with commands that stand still.

    Returns
    -------
    str
        A sentence; empty where the columns are not to blame.

    Notes
    -----
    It is asked only where the retuned model explains less than half of what y does, and it is said only where the
    other reading leaves less than half of that variance, and no more than effects do: an effect costs numbers, a
    reversed sign none. Columns of noise are no better read otherwise: the model then follows the command, too.
    """
    if 2.0 * quality.retuned**2 < 1.0:
        return ""
    readings = {
        "the sign of u, or of the model's gain, is reversed": [replace(r, u=2.0 * centre - r.u) for r in recordings],
        "the columns u and y are exchanged": [replace(r, u=r.y, y=r.u) for r in recordings],
    }
    for what, changed in readings.items():
        try:
            good, _ = inspect(changed, (), limits)
            if not all(ok.any() for ok in good):  # a command that never moves is no reading
                continue
            error, heeds = retuned(changed, good)
        except RUNAWAY:
            continue
        explains = 2.0 * error**2 < min(1.0, quality.retuned**2)
        if heeds and explains and error < (1.0 + limits.material) * quality.extended:
            return (
                f"First of all, {what}: so read, the retuned simulation errs by {error:.3g} of the spread of y on rows "
                f"that were left out, as they are by {quality.retuned:.3g}."
            )
    return ""
