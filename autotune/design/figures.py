"""The figures of one loop that a specification is held against, under one name each from kernel to report."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import DesignError
from autotune.models import LARGEST, SMALLEST


class Figures(NamedTuple):
    """What constraints (12) to (16) and the norm (11) are of a loop; floats, or arrays of one shape for many loops.

    Attributes
    ----------
    squared_norm : float or array
        Norm (11), squared.
    modulus : float or array
        Modulus margin (12), with a minus sign where the closed loop is unstable.
    phase_rad : float or array
        Phase margin (13) [rad].
    delay_s : float or array
        Delay margin [s].
    noise_gain : float or array
        (15): largest abs(C/(1 + L)) at and above omega_n.
    controller_gain : float or array
        (16): largest abs(C) at and above omega_n.
    """

    squared_norm: float | FloatArray
    modulus: float | FloatArray
    phase_rad: float | FloatArray
    delay_s: float | FloatArray
    noise_gain: float | FloatArray
    controller_gain: float | FloatArray


def require_frequency(name: str, value_rad_s: float) -> None:
    """Refuse what is no frequency.

    Parameters
    ----------
    name : str
        What it is, for the message.
    value_rad_s : float
        What was given [rad/s].

    Raises
    ------
    DesignError
        Not positive, or beyond what is computed with.
    """
    if not SMALLEST <= value_rad_s <= LARGEST:
        remedy = "it must be a positive frequency in rad/s"
        raise DesignError(f"{name} = {value_rad_s:g}", where="specification", remedy=remedy)


#: what :meth:`Specification.slacks` answers, in this order
CONSTRAINTS = ("modulus margin", "phase margin", "noise gain", "delay margin")


def columns(rows: FloatArray) -> Figures:
    """Return the (M, 6) rows of many loops as figures of (M,) arrays."""
    return Figures(*np.asarray(rows).T)
