"""The slowest of a plant's poles: what windows, durations and axes are measured by."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

#: As numpy answers them: real where all are.
Poles: TypeAlias = npt.NDArray[np.inexact[Any]]

#: Share of the fastest pole below which a rate is an integrator's, moved from zero by rounding.
_AT_ORIGIN = 1e-9


def slowest_lag_s(poles: Poles) -> float:
    """Return the slowest time constant 1/abs(Re p) [s], 0 where there is none.

    Parameters
    ----------
    poles : (n,) array
        Poles in s [rad/s], in any order; integrators and undamped pairs, which have no time constant, are left aside.
    """
    return _slowest(np.abs(np.real(poles)), poles)


def slowest_mode_s(poles: Poles) -> float:
    """Return the slowest mode's 1/abs(p) [s], of a pair 1/(2 pi) of its undamped period; 0 where there is none.

    Parameters
    ----------
    poles : (n,) array
        Poles in s [rad/s], in any order; integrators are left aside.
    """
    return _slowest(np.abs(poles), poles)


def moving(poles: Poles) -> Poles:
    """Return the poles that are no integrators."""
    return np.asarray(poles[np.abs(poles) > _limit(poles)])


def _slowest(rates: npt.NDArray[np.floating[Any]], poles: Poles) -> float:
    rates = rates[rates > _limit(poles)]
    return float(1.0 / rates.min()) if rates.size else 0.0


def _limit(poles: Poles) -> float:
    return _AT_ORIGIN * max(float(np.abs(poles).max(initial=0.0)), 1e-12)
