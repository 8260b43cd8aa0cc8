"""Where simulation and recording differ: which physics was left out.

A recording passes the room in this order:

``effects``
    the catalogue: one record per effect, one file per place
``simulation``
    a model with effects in it, compiled and driven by a recording
``fitting``
    noise, windows, free numbers, Gauss-Newton, restarts
``evidence``
    what samples, the control law, the residual and rows that were not fitted say
``selection``
    hypotheses: predicted, screened, fitted, compared
``verdict``, ``findings``, ``extended``, ``result``
    the table from evidence to a verdict, what is said, and the model to go on with

:func:`diagnose` walks through it.
"""

from autotune.diagnosis.diagnose import diagnose
from autotune.diagnosis.result import Diagnosis
from autotune.diagnosis.simulation.forecast import forecast

__all__ = ["Diagnosis", "diagnose", "forecast"]
