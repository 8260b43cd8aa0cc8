"""What a table says of a plant: gain, lags, dead time, and the step response as a few numbers."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from scipy import signal

from autotune.models import TransferFunction
from autotune.poles import slowest_mode_s

_VALUES = 40
_LAGS_SHOWN = 5.0
_DIGITS = 3


class PlantFigures(TypedDict):
    """Columns of the table of results that describe the fitted plant.

    ``gain`` is that of the plant without its integrators; ``lags_s`` the time constants, largest first, an oscillating
    pair as its natural frequency and damping; ``step`` the response to a unit step, 40 values evenly over ``step_s``.
    """

    gain: float
    integrators: int
    lags_s: str
    dead_time_s: float
    step: str
    step_s: float


def plant_figures(plant: TransferFunction) -> PlantFigures:
    """Return the columns of a plant.

    Parameters
    ----------
    plant : TransferFunction
        Strictly proper.
    """
    order = np.argsort(np.abs(plant.poles))
    poles = [complex(pole) for pole in plant.poles[order] if abs(pole) > 0.0 and pole.imag >= 0.0]
    slowest = slowest_mode_s(plant.poles) or max(plant.delay_s, 1.0)
    span = _LAGS_SHOWN * slowest + plant.delay_s
    t = np.linspace(0.0, span, _VALUES)
    late = np.linspace(0.0, _LAGS_SHOWN * slowest, 20 * _VALUES)
    _, rational = signal.step((plant.num, plant.den), T=late)
    step = np.interp(t - plant.delay_s, late, rational, left=0.0)
    return PlantFigures(
        gain=float(plant.num[-1] / plant.den[-1 - plant.integrators]),
        integrators=plant.integrators,
        lags_s=", ".join(map(_lag, poles)),
        dead_time_s=plant.delay_s,
        step=" ".join(f"{value:.{_DIGITS}g}" for value in step),
        step_s=span,
    )


def _lag(pole: complex) -> str:
    if pole.imag == 0.0:
        return f"{-1.0 / pole.real:.3g}"
    return f"{abs(pole):.3g} rad/s with damping {-pole.real / abs(pole):.2g}"
