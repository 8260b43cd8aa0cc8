"""From a finished sweep to a checked controller: on its points, else on the plant fitted to its rows in time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from autotune.config import Config
from autotune.config.procedure import DesignSettings
from autotune.design.noise import LoopFacts
from autotune.design.on_fit import design_on_fit
from autotune.design.synthesis import design
from autotune.errors import AutotuneError, DesignError, IdentificationError
from autotune.experiment.judgement import CONTRADICTED, contradict
from autotune.experiment.result import ExperimentResult
from autotune.experiment.together import Price
from autotune.identification.parametric import PlantFit
from autotune.identification.recorded_plant import fit_recordings
from autotune.identification.sweep_estimate import SweepEstimate
from autotune.one_thread import on_one_thread
from autotune.pipeline.analysis import Analysis, analyse, specification
from autotune.recording import Recording, read_recording

Tell = Callable[[str], None]


def analyse_sweep(
    experiment: ExperimentResult, settings: DesignSettings, facts: LoopFacts, folder: Path, tell: Tell
) -> Analysis:
    """Design on the sweep's points; on the plant fitted to its rows where the points' structures do not hold it.

    Points bound every aperiodic process with dead time, and two lags with a dead time are fitted to them. A plant that
    rings, answers the wrong way first, or has three equal lags is none of these, and the rows of its sweep tell it.

    Parameters
    ----------
    experiment : ExperimentResult
        The sweep.
    settings : DesignSettings
        What is asked of the controller.
    facts : LoopFacts
        Noise, range and sample time.
    folder : Path
        Where its recordings lie.
    tell : callable
        Told what takes long.

    Raises
    ------
    IdentificationError, DesignError
        No controller keeps its margins, by the points' own reason where the rows give no plant either.
    """
    analysis: Analysis | None = None
    reason: AutotuneError | None = None
    # points of all rows together share their errors: the plant is that of the rows, not one fitted to the points
    fit = None if experiment.together is None else experiment.together.fit
    try:
        analysis = analyse(experiment.points, settings, fit=fit, facts=facts)
    except (IdentificationError, DesignError) as error:
        reason = error
    if analysis is not None and not contradict(analysis.fit):
        return analysis
    try:
        tell("fitting the plant to the sweep's rows, for its points contradict the usual structures")
        fit = fit_rows(_read_cycles(experiment, folder))
        # the points are of the same rows, and what they say beyond the fit is the bias that made them contradict
        found = analyse((), settings, fit=fit, facts=facts)
    except AutotuneError as error:
        if analysis is not None:  # what it can be tried on is asked before it is
            return analysis
        raise (reason or error) from None
    note = "the plant was fitted to the rows of the sweep: its points contradict lags and a dead time"
    return replace(found, points=experiment.points, notes=(*found.notes, note))


@on_one_thread
def fit_rows(recordings: Sequence[Recording]) -> PlantFit:
    """Return the plant that explains the rows to within their noise.

    Raises
    ------
    IdentificationError
        None of the structures does.
    """
    fit = fit_recordings(recordings)
    if fit.p_value < CONTRADICTED:
        raise IdentificationError(
            f"no plant explains the sweep's rows: chi-square {fit.chi_square:.3g} at {fit.degrees_of_freedom} degrees"
            " of freedom",
            where="fit of the sweep",
            remedy="autotune diagnose looks for what else is in the plant",
        )
    return fit


def facts_of(config: Config, noise_sd: float) -> LoopFacts:
    """Return what a configuration and its sweep say of the loop.

    Parameters
    ----------
    config : Config
        Range of the command, and sample time.
    noise_sd : float
        Standard deviation of the noise that the sweep measured [y unit].
    """
    return LoopFacts(
        noise_sd=noise_sd,
        u_range=config.limits.u_max - config.limits.u_min,
        sample_time_s=config.signals.sample_time_s,
    )


def price_of(config: Config) -> Price | None:
    """Return what says how much dearer a controller is for what a sweep has not told yet; None where points are wanted.

    Parameters
    ----------
    config : Config
        Says what is wanted of sweep and controller.

    Notes
    -----
    It is the norm (11), on the estimate, of the controller that keeps its margins on all of the region, over that of
    the controller that keeps them on the estimate alone, less 1.
    """
    if config.experiment.goal == "points":
        return None
    settings = config.design

    def price(estimate: SweepEstimate, noise_sd: float) -> float:
        fit, highest = estimate.fit, estimate.points[-1].omega_rad_s
        asked, _ = specification(settings, fit, facts_of(config, noise_sd), highest)
        try:
            kept = design_on_fit(fit, asked, settings.kind).h2
            return kept / design(fit.plant, asked, settings.kind, certificate=False).h2 - 1.0
        except AutotuneError:  # no controller keeps the margins on so large a region
            return math.inf

    return price


def _read_cycles(experiment: ExperimentResult, folder: Path) -> tuple[Recording, ...]:
    """Return the rows of the limit cycles, sitting by sitting."""
    found = []
    for number, part in enumerate(experiment.parts):
        own = [segment for segment in experiment.segments if segment.part == number]
        if own:
            recording = read_recording(folder / part.recording)
            found.append(recording.between(own[0].start_s, own[-1].end_s))
    return tuple(found)
