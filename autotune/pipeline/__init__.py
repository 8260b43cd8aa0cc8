"""The stages in order: points to a checked controller, a rig to a verified one, gains into the rig's own controller."""

import importlib
from typing import TYPE_CHECKING, Any

from autotune.pipeline.analysis import Analysis, analyse
from autotune.pipeline.folder import CONTROLLER, JOURNAL, PROGRESS, RECORDING, RESULT, VERIFICATION, recordings
from autotune.pipeline.measured import Measured, measure_plant
from autotune.pipeline.result import analysis_json, write_result

if TYPE_CHECKING:
    from autotune.pipeline.deployment import hand_over
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
    "measure_plant",
    "recordings",
    "tune",
    "write_result",
]

#: What runs a rig is imported where one is run: a recording is tuned without it, in less time.
_OF_A_RIG = {"hand_over": "deployment", "DECISION_S": "run", "Tuning": "run", "tune": "run"}


def __getattr__(name: str) -> Any:
    if name not in _OF_A_RIG:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_OF_A_RIG[name]}"), name)
