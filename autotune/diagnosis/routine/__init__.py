"""Why a loop in operation oscillates, without a test and without a model: its valve, its tuning, something outside.

A recording becomes an :class:`~autotune.diagnosis.routine.operation.Operation` (one even grid, windows, stretches);
:mod:`~autotune.diagnosis.routine.valves` compares predictions by a valve's position with linear ones,
:mod:`~autotune.diagnosis.routine.oscillation` looks at phase and set-point, and
:mod:`~autotune.diagnosis.routine.judgement` says the verdict.
"""

from autotune.diagnosis.routine.judgement import diagnose_routine
from autotune.diagnosis.routine.result import RoutineDiagnosis

__all__ = ["RoutineDiagnosis", "diagnose_routine"]
