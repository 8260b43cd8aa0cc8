"""Time stamps: whether samples were taken evenly although their stamps are not.

A logger that stamps rows when they arrive over a line writes bursts and gaps that were none. Where a simulation at even
times is much nearer to the readings than one at the stamps, the stamps are wrong: everything else is then looked for at
even times.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from autotune.diagnosis.evidence.samples import JITTER, SampleEffect
from autotune.diagnosis.evidence.stretches import rms
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit
from autotune.diagnosis.fitting.retuning import prepare
from autotune.diagnosis.thresholds import Thresholds
from autotune.models import Model, Parameter
from autotune.recording import Recording


def uneven_share(recording: Recording) -> float:
    """Return the spread of the stamps about even ones, in sample times."""
    off = recording.t - np.linspace(recording.t[0], recording.t[-1], len(recording))
    return float(np.std(off) * (len(recording) - 1) / recording.duration_s)


def even_stamps(
    model: Model, recordings: Sequence[Recording], limits: Thresholds
) -> tuple[Sequence[Recording], SampleEffect | None]:
    """Return recordings at even times, and the jitter of their stamps, where that predicts far better.

    Parameters
    ----------
    model : Model
        Nominal model; its numbers are retuned at both.
    recordings : sequence of Recording
        With their stamps.
    limits : Thresholds
        What decides.

    Returns
    -------
    recordings, jitter
        The recordings as they are, and None, where their stamps are even or right.
    """
    if max(uneven_share(r) for r in recordings) < limits.uneven_stamps:
        return recordings, None
    at_even = [r.at_even_times() for r in recordings]
    good = [np.isfinite(r.y) for r in recordings]
    try:
        with np.errstate(all="ignore"):
            stamped, evenly = (prepare(model, rs, good, limits) for rs in (recordings, at_even))
    except RUNAWAY:
        return recordings, None
    if _rms(*evenly) > (1.0 - limits.material_numbers) * _rms(*stamped):
        return recordings, None
    sd = float(np.sqrt(np.mean(np.concatenate([(r.t - e.t) ** 2 for r, e in zip(recordings, at_even, strict=True)]))))
    gained = float(sum(len(r) for r in recordings) * np.log(_rms(*stamped) / _rms(*evenly)))
    return at_even, SampleEffect(
        name=JITTER,
        equation="rows were taken evenly and stamped when they arrived, d later",
        parameters=MappingProxyType({"sd": Parameter(value=sd, unit="s")}),
        evidence=gained,
    )


def _rms(data: Data, result: Fit) -> float:
    return rms(result.residuals, data.good)
