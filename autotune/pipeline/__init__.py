"""The stages in order: points to a checked controller, a rig to a verified one, gains into the rig's own controller."""

from autotune.pipeline.analysis import Analysis, analyse
from autotune.pipeline.deployment import hand_over
from autotune.pipeline.folder import CONTROLLER, JOURNAL, PROGRESS, RECORDING, RESULT, VERIFICATION, recordings
from autotune.pipeline.measured import Measured, measured_of
from autotune.pipeline.result import analysis_json, write_result
from autotune.pipeline.run import DECISION_S, Tuning, tune

__all__ = [
    "CONTROLLER",
    "DECISION_S",
    "JOURNAL",
    "PROGRESS",
    "RECORDING",
    "RESULT",
    "VERIFICATION",
    "Analysis",
    "Measured",
    "Tuning",
    "analyse",
    "analysis_json",
    "hand_over",
    "measured_of",
    "recordings",
    "tune",
    "write_result",
]
