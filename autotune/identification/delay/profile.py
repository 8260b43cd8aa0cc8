"""Likelihood intervals: how far each parameter may go, the others fitted again, before the record speaks against it.

Where a record determines a combination of the parameters poorly, the valley of the sum of squares bends, or runs on to
a pole or a delay that cancels, and the inverse information at the minimum says more than the record holds. The
intervals here follow the valley instead (Meeker & Escobar, Teaching about approximate confidence regions based on
maximum likelihood estimation, The American Statistician 49, 1995).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autotune.identification.delay.data import DelayData
from autotune.identification.delay.model import DelayModel
from autotune.identification.delay.output_error import Point, Structure, minimise, solve_linear
from autotune.identification.delay.output_error_model import parameters

_RISE = 1.96  # standard deviations at the ends of an interval: the root of the rise of the sum of squares
_FIRST = 0.5  # of the linearised interval
_LOWER = 0.5  # residual variances below the minimum: another minimum, not rounding
_FARTHEST = 10.0  # linearised intervals


@dataclass(frozen=True, kw_only=True, eq=False)
class Profile:
    """What following the valley found.

    Attributes
    ----------
    model : DelayModel
        The model, its standard deviations widened to the likelihood interval's farther end; correlations as they were.
    lower : Point or None
        A point with a smaller sum of squares that was met on the way: the fit should go on from there.
    endless : str
        The parameter whose interval has no end within reach, empty where all have one.
    """

    model: DelayModel
    lower: Point | None = None
    endless: str = ""


def profile(data: DelayData, structure: Structure, point: Point, model: DelayModel, *, max_delay_s: float) -> Profile:
    """Follow the valley from the minimum to both ends of the 95 % interval of every coefficient and of the delay.

    Parameters
    ----------
    data : DelayData
        Rows that any delay up to ``max_delay_s`` can explain, as the model was fitted to.
    structure : Structure
        Which parameters are free.
    point : Point
        The minimum.
    model : DelayModel
        The model there, with the covariance that the information gives.
    max_delay_s : float
        Upper limit of h [s].

    Notes
    -----
    The intervals of b, the constant and the initial state are those of the points met: they are linear in these
    parameters, and move along with the others.
    """
    n = structure.order
    sd = model.standard_deviations
    centre = parameters(data, point)
    farthest = _RISE * sd
    for j in [*np.flatnonzero(sd[:n]), n + 1]:
        for side in (-1.0, 1.0):
            end, rise = _walk(data, structure, point, model, int(j), side, max_delay_s)
            if rise < -_LOWER:
                return Profile(model=model, lower=end)
            if not rise > 0.0:
                return Profile(model=model, endless="the delay" if j == n + 1 else f"a{j}")
            moved = np.abs(parameters(data, end) - centre)
            farthest = np.maximum(farthest, moved * min(1.0, _RISE / np.sqrt(rise)))
    wider = np.where(sd > 0.0, farthest / (_RISE * np.where(sd > 0.0, sd, 1.0)), 1.0)
    return Profile(model=replace(model, covariance=model.covariance * np.outer(wider, wider)))


def _walk(
    data: DelayData, structure: Structure, point: Point, model: DelayModel, j: int, side: float, max_delay_s: float
) -> tuple[Point, float]:
    """Move parameter j outwards, the others following, to where the sum of squares has risen to the interval's end.

    Returns
    -------
    Point, float
        Where it ended and the rise there in residual variances: below -0.5 at a lower point, NaN where there is no end.
    """
    n = structure.order
    nonlinear = [*range(n), n + 1]
    reach_of_information = _RISE * model.standard_deviations[j]
    whitening = model.whitening
    held = 2 * n + 2 if j == n + 1 else 2 + n + j
    origin = np.append(point.a, point.h)
    j_among = nonlinear.index(j)
    along = model.covariance[nonlinear, j] / model.covariance[j, j]
    at, now, gone, rise = point, origin, 0.0, 0.0
    step = _FIRST * reach_of_information
    while gone < _FARTHEST * reach_of_information:
        wanted = now + side * step * along
        h = float(np.clip(wanted[n], 0.0, max_delay_s))
        start = solve_linear(data, structure, tuple(float(a) for a in wanted[:n]), h, whitening)
        if not np.isfinite(start.cost):
            break
        at = minimise(data, structure, start, max_delay_s=max_delay_s, whitening=whitening, tolerance=1e-3, held=held)
        rise = (at.cost - point.cost) / model.noise_sd**2
        if rise < -_LOWER or rise > (0.9 * _RISE) ** 2 or (j == n + 1 and h == 0.0):
            return at, rise if abs(rise) > 1e-6 else 1e-6
        if j == n + 1 and h == max_delay_s:
            break
        last, now = now, np.append(at.a, at.h)
        gone += step
        if now[j_among] != last[j_among]:  # the valley bends: its direction is that of the last step
            along = (now - last) / (now[j_among] - last[j_among])
        step *= float(np.clip((_RISE / np.sqrt(max(rise, 1e-6)) - 1.0) * gone / step, 0.5, 2.0))
    return at, float("nan")
