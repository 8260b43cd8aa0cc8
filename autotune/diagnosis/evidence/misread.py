"""Whether u or y is not what the model takes it for: a reversed sign, two columns exchanged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from autotune.diagnosis.evidence.held_out import FitQuality, held_out
from autotune.diagnosis.evidence.samples import inspect
from autotune.diagnosis.fitting.fit import RUNAWAY
from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.thresholds import Thresholds
from autotune.models import Model
from autotune.recording import Recording


def misread_columns(model: Model, recordings: Sequence[Recording], quality: FitQuality, thresholds: Thresholds) -> str:
    """Say what is wrong with the columns, where a model without further physics then explains the recordings.

    Parameters
    ----------
    model : Model
        The nominal chain.
    recordings : sequence of Recording
        What was measured.
    quality : FitQuality
        Errors of the model with the recordings as they are.
    thresholds : Thresholds
        What decides.

    Returns
    -------
    str
        A sentence; empty where the columns are not to blame.

    Notes
    -----
    It is asked only where the retuned model explains less than half of what y does, and it is said only where the
    other reading leaves less than half of that variance, and no more than effects do: an effect costs numbers, a
    reversed sign none.
    """
    if 2.0 * quality.retuned**2 < 1.0:
        return ""
    centre = model.input.offset
    readings = {
        "the sign of u, or of the model's gain, is reversed": [replace(r, u=2.0 * centre - r.u) for r in recordings],
        "the columns u and y are exchanged": [replace(r, u=r.y, y=r.u) for r in recordings],
    }
    for what, changed in readings.items():
        try:
            good, _ = inspect(changed, (), thresholds)
            if not all(ok.any() for ok in good):
                continue  # a command that never moves is no reading
            data, retuned = prepare(model, changed, good, thresholds)
        except RUNAWAY:
            continue
        error = held_out(retuned, data).retuned
        if 2.0 * error**2 < min(1.0, quality.retuned**2) and error < (1.0 + thresholds.material) * quality.extended:
            return (
                f"First of all, {what}: so read, the retuned simulation errs by {error:.3g} of the spread of y on rows "
                f"that were left out, as they are by {quality.retuned:.3g}."
            )
    return ""
