"""What files say about a plant: frequency points, a fit of plain recordings, noise and range of the command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.design.noise import LoopFacts, noise_of
from autotune.errors import AutotuneError
from autotune.identification.answer import require_answer
from autotune.identification.frequency.recorded import combine, session_points, sessions
from autotune.identification.frequency.spectral_points import FrequencyEstimate
from autotune.identification.frequency.windows import read_noted_windows
from autotune.identification.parametric import LEAST_POINTS, PlantFit
from autotune.identification.recorded_plant import fit_recordings
from autotune.one_thread import on_one_thread
from autotune.points import FrequencyPoint
from autotune.progress import Progress, quiet
from autotune.recording import Recording

#: recordings whose points say less than a fit of the whole record does; a relay's say more
_PLAIN = ("random or steps", "repeated command", "sines", "closed loop by way of r")


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What :func:`autotune.pipeline.analyse` is given.

    Attributes
    ----------
    points : tuple of FrequencyPoint
        Of all recordings and files.
    fit : PlantFit or None
        Of plain recordings, or of all rows of a sweep together; None where the points are to be fitted.
    facts : LoopFacts
        Noise, span of the command and sample time of the recordings.
    notes : tuple of str
        What was left out, and why.
    """

    points: tuple[FrequencyPoint, ...]
    fit: PlantFit | None
    facts: LoopFacts
    notes: tuple[str, ...]


@on_one_thread
def measure_plant(
    recordings: Sequence[Recording], given: Sequence[FrequencyPoint] = (), progress: Progress = quiet
) -> Measured:
    """Return what recordings and given points say about their plant.

    Parameters
    ----------
    recordings : sequence of Recording
        Relay experiments, closed loops with a set-point that moves, or plain recordings with a command that moves.
    given : sequence of FrequencyPoint
        Points of other files.
    progress : Progress
        Told what is being done.

    Raises
    ------
    AutotuneError
        y does not answer u beyond chance, or neither points nor a fit can be had of them.
    """
    # an experiment that noted its limit cycles has seen y answer, and few of them say little of it
    plain = [one for one in recordings if not read_noted_windows(one)]
    if plain:
        progress("asking whether y answers u", 0.0)
        require_answer(plain)
    estimates: list[FrequencyEstimate] = []
    notes: list[str] = []
    reason: AutotuneError | None = None
    for session in sessions(recordings):
        try:
            estimates.append(session_points(session))
        except AutotuneError as error:
            reason = reason or error
            notes.append(f"no frequency points: {error}")
    combined = combine(estimates) if estimates else None
    fit = combined.fit if combined is not None and not given else None
    few = fit is None and combined is not None and len(combined.points) < LEAST_POINTS
    if recordings and not given and (few or all(one.excitation in _PLAIN for one in estimates)):
        try:
            by_way_of_r = [one for one in combined.points if one.source == "closed loop"] if combined else []
            fit = fit_recordings([_from_first_cycle(one) for one in recordings], progress, by_way_of_r)
        except AutotuneError as error:
            notes.append(str(error))
            reason = reason or error
    points = (*(combined.points if combined else ()), *given)
    if fit is None and len(points) < LEAST_POINTS and reason is not None:
        raise reason
    return Measured(
        points=points, fit=fit, facts=_facts(recordings), notes=(*notes, *(combined.notes if combined else ()))
    )


def _from_first_cycle(recording: Recording) -> Recording:
    """Return the rows from the first noted limit cycle on: before it the plant was brought from rest."""
    windows = read_noted_windows(recording)
    return recording.between(windows[0].window.start_s, float(recording.t[-1])) if windows else recording


def _facts(recordings: Sequence[Recording]) -> LoopFacts:
    if not recordings:
        return LoopFacts()
    return LoopFacts(
        noise_sd=float(np.median([noise_of(one.y) for one in recordings])),
        u_span=max(float(np.ptp(one.u)) for one in recordings),
        # as it is stated: the last digit of a difference of times has moved a controller
        sample_time_s=max(one.stated_sample_time_s for one in recordings),
    )
