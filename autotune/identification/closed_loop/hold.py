"""The command's hold taken out of an identified response, so that it compares with points measured otherwise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import expm, logm

from autotune.arrays import FloatArray
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.points import FrequencyPoint, as_pairs

#: A point less certain than this says nothing to a design.
_WORTHLESS = 0.5


def without_hold(model: InnovationModel, response: Sequence[FrequencyPoint]) -> tuple[FrequencyPoint, ...]:
    """Return the points of the plant itself, with the hold of the command taken out.

    Parameters
    ----------
    model : InnovationModel
        One input, one output, identified from commands held over each sample.
    response : sequence of FrequencyPoint
        Its response G(exp(j omega Ts)).

    Returns
    -------
    tuple of FrequencyPoint
        P(j omega) of the continuous plant whose step-invariant equivalent the model is. Where it has none (a pole on
        the negative real axis, which a sampled lag does not have) the response divided by that of the hold, up to half
        the Nyquist frequency.
    """
    dt_s = model.sample_time_s
    continuous = continuous_form(model)
    points = []
    for point in response:
        omega = point.omega_rad_s
        if continuous is None:
            if omega * dt_s > math.pi / 2.0:
                continue
            factor = complex(1j * omega * dt_s / (1.0 - np.exp(-1j * omega * dt_s)))
        else:
            A, B = continuous
            inner = model.C @ np.linalg.solve(1j * omega * np.eye(len(A)) - A, B) + model.D
            factor = complex(inner[0, 0]) * np.exp(-1j * omega * dt_s * model.input_delay) / point.response
        turn = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
        c = turn @ np.array(point.covariance) @ turn.T
        points.append(replace(point, response=complex(point.response * factor), covariance=as_pairs(c)))
    return tuple(points)


def worthwhile(points: Sequence[FrequencyPoint]) -> tuple[FrequencyPoint, ...]:
    """Return the points that are known to better than 50 %."""
    return tuple(p for p in points if np.trace(np.array(p.covariance)) / 2.0 < (_WORTHLESS * abs(p.response)) ** 2)


def continuous_form(model: InnovationModel) -> tuple[FloatArray, FloatArray] | None:
    """Return (A, B) of the continuous model with the same samples under a held input, None where there is none."""
    poles = model.poles
    if np.any((np.abs(poles.imag) <= 1e-9) & (poles.real <= 1e-9)):
        return None
    n = model.order
    joint = np.block([[model.A, model.B], [np.zeros((1, n)), np.ones((1, 1))]])
    generator = logm(joint)
    if not np.allclose(expm(generator), joint, rtol=1e-8, atol=1e-10) or np.max(np.abs(np.imag(generator))) > 1e-8:
        return None
    generator = np.real(generator) / model.sample_time_s
    return generator[:n, :n], generator[:n, n:]
