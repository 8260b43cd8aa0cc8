"""Parameters that move within a window: the mean of each over the window, and an interval that holds it.

A model with constant parameters, fitted to a record in which one of them moved, gives its value where the record
excited most, and the interval of a constant. Here every coefficient, the gain and the delay may also move linearly in
time: the sensitivity to that is, for a movement that is slow against the plant, the sensitivity to the parameter times
the time from the window's middle. What the joint fit moves the level by is what the constant fit was off the mean by.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.distributions import chi2_quantile
from autotune.identification.delay.data import DelayData
from autotune.identification.delay.model import DelayModel
from autotune.identification.delay.output_error import Structure, solve_linear
from autotune.identification.delay.response import output

#: Probability with which constants may be taken for moving.
_LEVEL = 0.05
#: Step of a difference, in standard deviations.
_STEP = 0.1


def mean_over_window(data: DelayData, structure: Structure, model: DelayModel) -> DelayModel:
    """Return a model of the parameters' means over a window, with a covariance that a linear drift has been counted in.

    Parameters
    ----------
    data : DelayData
        The window, as the model was fitted to it.
    structure : Structure
        Which parameters are free.
    model : DelayModel
        Fit with constant parameters.

    Returns
    -------
    DelayModel
        The same where nothing shows that they moved, its covariance widened by what a movement that does not show could
        have done, at most doubled; the means of the joint fit and its covariance otherwise.

    Notes
    -----
    First order in the drift; what moves faster than the window is averaged as the record weights it.
    """
    usable = data.usable_from(model.delay_s * 1.02)
    whitening = model.whitening
    point = solve_linear(usable, structure, model.a, model.delay_s, whitening)
    if not np.isfinite(point.cost) or usable.ty.size < 6 * structure.parameters:
        return model
    levels, moving = _sensitivities(usable, structure, model, point.theta)
    middle, half = 0.5 * (usable.ty[0] + usable.ty[-1]), 0.5 * (usable.ty[-1] - usable.ty[0])
    slopes = levels[:, moving] * ((usable.ty - middle) / half)[:, None]
    errors = usable.y - output(usable, model.a, model.delay_s, point.theta)
    filtered = whitening.filtered(np.column_stack([levels, slopes, errors]))[whitening.lost :]
    scale = np.linalg.norm(filtered, axis=0) + 1e-300
    matrix = filtered[:, :-1] / scale[:-1]
    if np.linalg.cond(matrix) > 1e7:
        return model
    solution = np.linalg.lstsq(matrix, filtered[:, -1], rcond=None)[0]
    left = filtered[:, -1] - matrix @ solution
    variance = float(left @ left) / max(len(left) - matrix.shape[1], 1)
    joint = variance * np.linalg.inv(matrix.T @ matrix) / np.outer(scale[:-1], scale[:-1])
    step = solution / scale[:-1]
    count = levels.shape[1]
    statistic = step[count:] @ np.linalg.solve(joint[count:, count:], step[count:])
    moved = bool(statistic > chi2_quantile(1.0 - _LEVEL, len(moving)))
    return _with(model, structure, moving, step, joint, moved=moved)


def _sensitivities(
    data: DelayData, structure: Structure, model: DelayModel, theta: FloatArray
) -> tuple[FloatArray, list[int]]:
    """Return the response's sensitivities to (a, b, h, d, initial state), free ones only, and which may move."""
    n = structure.order
    sd = np.maximum(model.standard_deviations, 1e-9 * np.abs(model.values) + 1e-12)
    columns: list[FloatArray] = []
    for i in range(int(structure.integrator), n):
        ends = [
            output(data, (*model.a[:i], model.a[i] + s * _STEP * sd[i], *model.a[i + 1 :]), model.delay_s, theta)
            for s in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1]) / (2.0 * _STEP * sd[i]))
    gain = np.zeros_like(theta)
    gain[0] = 1.0
    columns.append(output(data, model.a, model.delay_s, gain))
    width = min(_STEP * sd[n + 1] + 1e-6 * model.delay_s, model.delay_s) or 1e-6
    ahead = output(data, model.a, model.delay_s + width, theta)
    behind = output(data, model.a, max(model.delay_s - width, 0.0), theta)
    columns.append((ahead - behind) / (model.delay_s + width - max(model.delay_s - width, 0.0)))
    moving = list(range(len(columns)))
    for k in np.flatnonzero(structure.linear)[1:]:
        unit = np.zeros_like(theta)
        unit[k] = 1.0
        columns.append(output(data, model.a, model.delay_s, unit))
    return np.column_stack(columns), moving


def _with(
    model: DelayModel, structure: Structure, moving: list[int], step: FloatArray, joint: FloatArray, *, moved: bool
) -> DelayModel:
    n = structure.order
    own = [*range(int(structure.integrator), n), n, n + 1]  # places of what may move in the model's covariance
    covariance = model.covariance.copy()
    wide = joint[np.ix_(moving, moving)]
    if moved:
        values = model.values
        values[own] += step[moving]
        covariance[:, own], covariance[own, :] = 0.0, 0.0
        covariance[np.ix_(own, own)] = wide
        return replace(
            model,
            a=tuple(float(value) for value in values[:n]),
            b=float(values[n]),
            delay_s=max(float(values[n + 1]), 0.0),
            covariance=covariance,
        )
    sd = np.sqrt(np.diag(covariance)[own])
    factor = np.clip(np.sqrt(np.diag(wide)) / np.where(sd > 0.0, sd, np.inf), 1.0, np.sqrt(2.0))
    scale = np.ones(len(covariance))
    scale[own] = factor
    return replace(model, covariance=covariance * np.outer(scale, scale))
