"""What explains the residual better than any effect of the chain: a clock that jitters, another control law."""

from __future__ import annotations

from collections.abc import Sequence

from autotune.controller import Controller
from autotune.diagnosis.evidence.adequacy import is_white
from autotune.diagnosis.evidence.constancy import largest_variation
from autotune.diagnosis.evidence.jitter import jitter_effect
from autotune.diagnosis.evidence.law import law_effect
from autotune.diagnosis.evidence.samples import SampleEffect
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.retuning import reduced_chi2
from autotune.effects import kind_of
from autotune.recording import Recording


def beside_chain(
    retuned: Fit,
    data: Data,
    gained: float,
    recordings: Sequence[Recording],
    controller: Controller | None,
    seen: Sequence[SampleEffect],
) -> list[SampleEffect]:
    """Return what is no effect of the chain and explains the residual better than one: jitter, another control law.

    Parameters
    ----------
    retuned : Fit
        The nominal structure fitted.
    data : Data
        What it was fitted to.
    gained : float
        Penalised chi-square that effects of the chain gained beside it.
    recordings : sequence of Recording
        All rows of what was measured.
    controller : Controller, optional
        The law that u was computed by; the sidecars' by default.
    seen : sequence of SampleEffect
        What single samples show.
    """
    limits = data.thresholds
    excluded = {name for s in seen for name in kind_of(s.name).excludes}
    jitter = None if "timing.jitter" in excluded else jitter_effect(retuned, recordings, limits.jitter_decrease)
    if jitter is not None and largest_variation(retuned, data).gain > jitter.evidence:
        jitter = None  # what is left goes with a signal, and that grows with the slope too
    both = [s for s in (jitter, law_effect(recordings, controller, limits)) if s is not None]
    quick = not data.noise.ar or data.noise.ar[0] < limits.slow_noise
    near = reduced_chi2(retuned, data) < limits.coarse
    # a stamp that is wrong disturbs single rows: effects of the chain would leave something slow as well
    fast = is_white(retuned, data) and quick and near
    return [
        s
        for s in both
        if (s.evidence > max(limits.samples_share * gained, limits.samples_sure) and fast)
        or (s.evidence > gained and (s.name != "timing.jitter" or (quick and near)))
    ]
