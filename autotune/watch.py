"""Whether the deployed controller still meets its margins on the tracked model, the model's uncertainty counted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import Controller
from autotune.design.margins import margins
from autotune.identification.delay.model import DelayModel
from autotune.models import TransferFunction

_CONFIDENT = 1.645  # standard deviations: one-sided 95 %


@dataclass(frozen=True, kw_only=True)
class Advice:
    """What to do about the deployed controller.

    Attributes
    ----------
    verdict : {"keep", "unsure", "retune"}
        Keep where both margins are met with 95 % confidence, retune where one is missed with 95 % confidence.
    modulus, modulus_sd : float
        Modulus margin on the tracked model.
    phase_rad, phase_sd_rad : float
        Phase margin [rad].
    stable : bool
        Whether the loop of controller and tracked model is stable.
    """

    verdict: Literal["keep", "unsure", "retune"]
    modulus: float
    modulus_sd: float
    phase_rad: float
    phase_sd_rad: float
    stable: bool


def advise(model: DelayModel, controller: Controller, *, modulus_margin: float, phase_margin_rad: float) -> Advice:
    """Judge a controller on a tracked model.

    Parameters
    ----------
    model : DelayModel
        The tracked model and its covariance.
    controller : PIDController, TransferFunction or DiscreteController
        What the loop runs with.
    modulus_margin, phase_margin_rad : float
        Margins the design was to keep, the latter in [rad].

    Returns
    -------
    Advice
        Margins with standard deviations by the delta method: first order, so too narrow near instability, where the
        verdict follows from stability itself.
    """
    n = model.order
    values, sds = model.values[: n + 2], model.standard_deviations[: n + 2]

    def of(parameters: FloatArray) -> tuple[FloatArray, bool]:
        plant = TransferFunction(
            num=(float(parameters[n]),),
            den=(1.0, *(-float(a) for a in parameters[n - 1 :: -1])),
            delay_s=max(float(parameters[n + 1]), 0.0),
        )
        found = margins(plant, controller)
        return np.array([found.modulus, found.phase_rad]), found.stable

    here, stable = of(values)
    jacobian = np.zeros((2, n + 2))
    for i in np.flatnonzero(sds):
        step = np.zeros(n + 2)
        step[i] = 0.1 * sds[i]
        jacobian[:, i] = (of(values + step)[0] - here) / step[i]
    covariance = jacobian @ model.covariance[: n + 2, : n + 2] @ jacobian.T
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    required = np.array([modulus_margin, phase_margin_rad])
    verdict: Literal["keep", "unsure", "retune"] = "unsure"
    if not stable or np.any(here + _CONFIDENT * sd < required):
        verdict = "retune"
    elif np.all(here - _CONFIDENT * sd >= required):
        verdict = "keep"
    return Advice(
        verdict=verdict,
        modulus=float(here[0]),
        modulus_sd=float(sd[0]),
        phase_rad=float(here[1]),
        phase_sd_rad=float(sd[1]),
        stable=stable,
    )
