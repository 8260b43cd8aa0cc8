"""Whether y answers a few steps or ramps of u: by what a plant with dead time explains of it that chance would not.

The few moves of a step test say little about correlation, which is why a test of independence refuses them; they say
much by the shape of the answer. A plant is fitted, and what it leaves of y is compared with what is left without u:
constant, free response and noise of whatever colour (an autoregression) are given to both.
"""

from __future__ import annotations

import math

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import AutotuneError
from autotune.identification.delay.data import DelayData, prepare
from autotune.identification.delay.identify import identify_delay
from autotune.identification.delay.model import DelayModel
from autotune.identification.delay.output_error import Structure, residuals, solve_linear
from autotune.recording import Recording

#: Twice the logarithm of the likelihood that u must be worth: over 150 records of white noise, autoregressions, random
#: walks and drifts under steps and ramps the largest was 41, and each logarithm of a rarer chance costs about 2.
NEEDED = 50.0
#: u is a test, and not what a controller makes, where it is held or runs straight in so many of its rows
_STRAIGHT = 0.9
#: order, and whether it integrates
_STRUCTURES = ((1, False), (2, False), (2, True))
_AR_ORDERS = (0, 1, 2, 4, 8, 16, 32)


def is_simple_test(u: FloatArray) -> bool:
    """Return whether a command is held or runs straight in nine rows of ten."""
    bends = np.abs(np.diff(u, 2)) > 1e-9 * float(np.ptp(u))
    return bool(np.mean(bends) < 1.0 - _STRAIGHT)


def plant_evidence(recording: Recording) -> float:
    """Return twice the logarithm of the likelihood that a plant's answer to u is worth beside coloured noise alone.

    Parameters
    ----------
    recording : Recording
        Under steps or ramps of u in open loop.

    Returns
    -------
    float
        The best of orders 1 and 2, with and without an integrator; 0 where none is determined.
    """
    best = 0.0
    for order, integrator in _STRUCTURES:
        try:
            model = identify_delay(recording, order, integrator=integrator)
            data = prepare(recording).usable_from(model.delay_s)
        except AutotuneError:
            continue
        best = max(best, _gain_in_likelihood(data, model, Structure(order=order, integrator=integrator)))
    return best


def _gain_in_likelihood(data: DelayData, model: DelayModel, structure: Structure) -> float:
    with_u = residuals(data, solve_linear(data, structure, model.a, model.delay_s))
    t = data.ty - data.ty[0]
    modes = [np.ones_like(t)]
    for pole in model.poles:
        if pole == 0.0:
            modes.append(t / t[-1])
            continue
        decay = np.exp(np.minimum(pole.real * t, 50.0))
        modes += [decay * np.cos(pole.imag * t), decay * np.sin(pole.imag * t)][: 2 if pole.imag else 1]
    free = np.column_stack(modes)
    without = data.y - free @ np.linalg.lstsq(free, data.y, rcond=None)[0]
    return float(t.size * math.log(_innovation_variance(without) / _innovation_variance(with_u)))


def _innovation_variance(x: FloatArray) -> float:
    """Return the variance that an autoregression leaves, its order by Akaike's criterion."""
    most = max(order for order in _AR_ORDERS if order <= x.size // 8)
    past = np.column_stack([x[most - k : x.size - k] for k in range(1, most + 1)])
    found = []
    for order in (order for order in _AR_ORDERS if order <= most):
        weights = np.linalg.lstsq(past[:, :order], x[most:], rcond=None)[0]
        variance = float(np.mean((x[most:] - past[:, :order] @ weights) ** 2)) + 1e-300
        found.append((x.size * math.log(variance) + 2.0 * order, variance))
    return min(found)[1]
