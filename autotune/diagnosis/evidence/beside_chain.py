"""What is beside the chain: a clock that jitters, another control law."""

from __future__ import annotations

from collections.abc import Sequence

from autotune.controller import Controller
from autotune.diagnosis.evidence.adequacy import is_noise
from autotune.diagnosis.evidence.constancy import largest_variation
from autotune.diagnosis.evidence.jitter import jitter_effect
from autotune.diagnosis.evidence.law import law_effect
from autotune.diagnosis.evidence.samples import SampleEffect
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.effects import kind_of
from autotune.recording import Recording


def beside_chain(
    result: Fit,
    data: Data,
    recordings: Sequence[Recording],
    controller: Controller | None,
    seen: Sequence[SampleEffect],
) -> list[SampleEffect]:
    """Return what is no effect of the chain: jitter of the stamps, another control law.

    Parameters
    ----------
    result : Fit
        A fit at its minimum.
    data : Data
        What it was fitted to.
    recordings : sequence of Recording
        All rows of what was measured.
    controller : Controller, optional
        The law that u was computed by; the sidecars' by default.
    seen : sequence of SampleEffect
        What single samples show.
    """
    limits = data.thresholds
    excluded = {name for s in seen for name in kind_of(s.name).excludes}
    jitter = None if "timing.jitter" in excluded else jitter_effect(result, recordings, limits.jitter_decrease)
    # a stamp that is wrong disturbs single rows; what goes with a signal grows with the slope as well
    if jitter is not None and not (is_noise(result, data) and largest_variation(result, data).gain < jitter.evidence):
        jitter = None
    return [s for s in (jitter, law_effect(recordings, controller, limits)) if s is not None]
