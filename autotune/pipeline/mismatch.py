"""Why a loop did not behave as predicted: the run's own recordings diagnosed against the plant fitted to its points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy.signal import lfilter

from autotune.config import Config
from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.result import Diagnosis
from autotune.experiment.prediction import sampled
from autotune.experiment.result import ExperimentResult
from autotune.experiment_design.next_experiment import with_next_experiment
from autotune.identification.parametric import PlantFit
from autotune.models import Block, Model, Port, TransferFunction
from autotune.progress import Progress
from autotune.recording import Recording, read_recording


def model_of_fit(config: Config, fit: PlantFit, u_rest: float) -> Model:
    """Return the plant fitted to the points as a chain around the operating point.

    Parameters
    ----------
    config : Config
        Names, units and the operating point.
    fit : PlantFit
        The plant.
    u_rest : float
        Command that holds the operating point [u unit].
    """
    signals = config.signals
    return Model(
        name=f"{config.name}, fitted to its Bode points",
        input=Port(unit=signals.u_unit, offset=u_rest),
        output=Port(unit=signals.y_unit, offset=config.operating_point.y),
        blocks=(Block(name="fitted plant", place="plant", dynamics=fit.plant),),
    )


def resting_command(recording: Recording, plant: TransferFunction, u_rest: float, y_rest: float) -> float:
    """Return the command that holds the operating point, by least squares with the start state free [u unit].

    The mean command over the limit cycles is good to a thousandth of the range; over a whole sweep an integrating plant
    tells it ten times as well, and a diagnosis would call the difference an offset.

    Parameters
    ----------
    recording : Recording
        Rows around the operating point.
    plant : TransferFunction
        The plant.
    u_rest, y_rest : float
        The command as known so far [u unit]; the operating point [y unit].
    """
    num, den = sampled(plant, recording.sample_time_s)
    ok = np.isfinite(recording.y)
    impulse = np.zeros(len(recording))
    impulse[0] = 1.0
    free = [lfilter(np.eye(1, k + 1, k)[0], den, impulse) for k in range(len(den) - 1)]
    constant = lfilter(num, den, np.ones(len(recording)))
    left = recording.y - y_rest - lfilter(num, den, recording.u - u_rest)
    solution = np.linalg.lstsq(np.column_stack([constant, *free])[ok], left[ok], rcond=None)[0]
    return u_rest - float(solution[0])


def around_operating_point(recording: Recording) -> Recording | None:
    """Return the rows in which the plant was held at its operating point, None where there are none.

    On its way there a plant meets its ends and its rest, which a model of the operating point does not describe. The
    set-point is left out: the law that made u is this tool's own, and its load step is no part of it.
    """
    recording = replace(recording, extra=MappingProxyType({}))
    cycles = recording.metadata.get("relay", [])
    if cycles:
        half = 0.5 * recording.sample_time_s  # the file rounds the stamps
        return recording.between(cycles[0]["start_s"] - half, cycles[-1]["end_s"] - half)
    if "test_start_s" in recording.metadata:
        # the last row's command is the safe one
        return recording.between(recording.metadata["test_start_s"], float(recording.t[-1]))
    return None


def diagnose_run(
    config: Config, experiment: ExperimentResult, fit: PlantFit, files: Sequence[Path], progress: Progress
) -> Diagnosis:
    """Find what the fitted plant leaves out of the run's recordings.

    Parameters
    ----------
    config, experiment, fit
        Of the run.
    files : sequence of Path
        Its recordings, sweep and verification.
    progress : callable
        Told what is being done and the share done, 0 to 1.

    Raises
    ------
    InputError
        Too few rows at the operating point.
    """
    read = [around_operating_point(read_recording(path)) for path in files]
    rows = [one for one in read if one is not None]
    u_rest = resting_command(rows[0], fit.plant, experiment.u_rest, config.operating_point.y)
    return with_next_experiment(diagnose(model_of_fit(config, fit, u_rest), rows, progress=progress))
