"""Relay autotuner with hardware in the loop: measures a rig's Bode points, designs its controller, verifies it.

In Python, ``import autotune as at``:

=====================  ======================================================================================
``read``               a recording from a file, a DataFrame or arrays
``example``            recordings and plants to try things on
``frequency_points``   points of the frequency response, with covariance
``reduce``             the cautious model of points or of a plant
``tune``               PI or PID with margins, on points or on a model
``rst``                RST by pole placement, to compare with
``margins``            margins of a loop
``validate``           nu-gap and stability margins b of a model beside its plant
``delay``              coefficients and dead time, by three methods; two delays
``OnlineEstimator``    the same row by row, for a live rig
``closed_loop``        the plant from a recording of its loop, by the papers' methods
``transition``         the fastest smooth transition within limits
``Model``              a model from a file, equations, python-control, a written formula, a step function
``simulate``           a model driven by a recording
``diagnose``           where and why recordings differ from a model
``plot``               any result, on matplotlib axes or as an interactive chart
``to_control``         to python-control, and ``from_control`` back
``to_pandas``          any result as a DataFrame
=====================  ======================================================================================

``PI``, ``TransferFunction``, ``Recording``, ``read_model`` and ``read_controller`` make what these take. Results show
themselves in a notebook. The rooms below (``autotune.identification``, ``autotune.design``, ..) can be imported too.
"""

from __future__ import annotations

import sys

_started = sys.argv[0] if sys.argv else ""
if _started.endswith(("/autotune", "\\autotune", "autotune.exe")) or (
    _started == "-m" and any(word.startswith("autotune") for word in sys.orig_argv)
):
    from autotune.early import hear  # the command line, and what is imported below takes its time

    hear()

import importlib  # noqa: E402 - heard before it is imported
from typing import TYPE_CHECKING, Any  # noqa: E402

from autotune.version import __version__ as __version__  # noqa: E402

if TYPE_CHECKING:
    from autotune.api.control_systems import to_control as to_control
    from autotune.api.diagnosing import diagnose as diagnose
    from autotune.api.diagnosing import simulate as simulate
    from autotune.api.examples import example as example
    from autotune.api.methods import closed_loop as closed_loop
    from autotune.api.methods import delay as delay
    from autotune.api.methods import margins as margins
    from autotune.api.methods import reduce as reduce
    from autotune.api.methods import transition as transition
    from autotune.api.methods import tune as tune
    from autotune.api.methods import validate as validate
    from autotune.api.models import Model as Model
    from autotune.api.plots import plot as plot
    from autotune.api.points import Points as Points
    from autotune.api.points import frequency_points as frequency_points
    from autotune.api.pole_placement import rst as rst
    from autotune.api.python_control import from_control as from_control
    from autotune.api.recordings import read as read
    from autotune.api.shown import to_pandas as to_pandas
    from autotune.controller import PIDController as PI  # noqa: F401, N814 - as people write it
    from autotune.controller import read_controller as read_controller
    from autotune.identification.delay.online_modulating import OnlineEstimator as OnlineEstimator
    from autotune.model_tables import read_model as read_model
    from autotune.models import TransferFunction as TransferFunction
    from autotune.recording import Recording as Recording

#: name -> module and name there
_HOMES = {
    "read": "autotune.api.recordings",
    "example": "autotune.api.examples",
    "frequency_points": "autotune.api.points",
    "Points": "autotune.api.points",
    "reduce": "autotune.api.methods",
    "tune": "autotune.api.methods",
    "rst": "autotune.api.pole_placement",
    "margins": "autotune.api.methods",
    "validate": "autotune.api.methods",
    "delay": "autotune.api.methods",
    "closed_loop": "autotune.api.methods",
    "transition": "autotune.api.methods",
    "Model": "autotune.api.models",
    "simulate": "autotune.api.diagnosing",
    "diagnose": "autotune.api.diagnosing",
    "plot": "autotune.api.plots",
    "to_control": "autotune.api.control_systems",
    "from_control": "autotune.api.python_control",
    "to_pandas": "autotune.api.shown",
    "PI": "autotune.controller:PIDController",
    "OnlineEstimator": "autotune.identification.delay.online_modulating",
    "TransferFunction": "autotune.models",
    "Recording": "autotune.recording",
    "read_model": "autotune.model_tables",
    "read_controller": "autotune.controller",
}

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: the command line and a bare import stay fast."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'autotune' has no attribute {name!r}")
    importlib.import_module("autotune.api.shown")  # results show themselves from the first one on
    if hasattr(sys, "ps1"):  # a notebook, or a prompt at which a person waits; a program's stderr is its own
        importlib.import_module("autotune.compiling").announce_compiling()
    module, _, there = home.partition(":")
    value = getattr(importlib.import_module(module), there or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
