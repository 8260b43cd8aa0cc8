"""From the minimum of an output-error fit to its model: parameters, covariance, the colour of the noise."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError
from autotune.identification.delay.data import DelayData
from autotune.identification.delay.model import DelayModel
from autotune.identification.delay.output_error import Point, Structure, minimise, residuals, solve_linear
from autotune.identification.delay.response import normal_matrix, sensitivities
from autotune.identification.noise_colour import MAX_AR, NoiseColour, noise_colour
from autotune.identification.noise_filter import WHITE, Whitening, load_filters

#: Time constants from one row to the next after which nothing of a lag is left but rounding.
_NOTHING_LEFT = -math.log(np.finfo(np.float64).eps)


def parameters(data: DelayData, point: Point) -> FloatArray:
    """Return (a_0.., b, delay, constant, initial state) of a point, the operating point added back.

    Parameters
    ----------
    data : DelayData
        Holds the operating point.
    point : Point
        Of order n.

    Returns
    -------
    (2n + 3,) array
        In the units of y, u and s.
    """
    b, d = float(point.theta[0]), float(point.theta[1])
    initial = point.theta[2:].copy()
    initial[0] += data.y_0
    return np.array([*point.a, b, point.h, d - b * data.u_0 - point.a[0] * data.y_0, *initial])


def finish(data: DelayData, structure: Structure, point: Point, whitening: Whitening = WHITE) -> DelayModel:
    """Return the model with its covariance at a minimum, the operating point added back.

    Parameters
    ----------
    data : DelayData
        The record.
    structure : Structure
        Which parameters are free.
    point : Point
        The minimum.
    whitening : Whitening
        Makes the noise white.

    Raises
    ------
    IdentificationError
        The information matrix is singular: some combination of the parameters does not show in the data.
    """
    n = structure.order
    inner = inverse_information(data, structure, point, whitening)
    if inner is None:
        raise _singular(data, structure, point, whitening)
    variance = point.cost / (point.rows - structure.parameters)
    back = _to_parameters(data, structure, point)
    values = parameters(data, point)
    return DelayModel(
        a=point.a,
        b=float(values[n]),
        delay_s=point.h,
        constant=float(values[n + 2]),
        initial_time_s=float(data.ty[0]),
        initial_state=tuple(float(value) for value in values[n + 3 :]),
        covariance=variance * back @ inner @ back.T,
        noise_sd=float(np.sqrt(variance)),
        noise_ar=tuple(float(value) for value in whitening.ar),
        noise_ma=tuple(float(value) for value in whitening.ma),
        rows=point.rows,
    )


def inverse_information(
    data: DelayData, structure: Structure, point: Point, whitening: Whitening = WHITE
) -> FloatArray | None:
    """Return the inverse of the sensitivities' Gram matrix at a minimum; None where the rows do not determine all.

    Parameters
    ----------
    data : DelayData
        The record.
    structure : Structure
        Which parameters are free.
    point : Point
        The minimum.
    whitening : Whitening
        Makes the noise white.

    Returns
    -------
    (2n + m + 3, 2n + m + 3) array or None
        Of (b_0, d, initial state, b_1..b_m, a, h), rows of what is known 0; times the variance of what is left it is
        their covariance, but for the initial state's, which leaves out the free responses.
    """
    free = np.flatnonzero(structure.free)
    gram, finite = normal_matrix(data, point.a, point.h, point.theta, True, whitening)
    information = gram[np.ix_(free, free)]
    scale = np.sqrt(np.diag(information))
    if not finite or not np.all(scale > 0) or np.linalg.cond(information / np.outer(scale, scale)) > 1e13:
        return None
    inverse = np.zeros((len(gram) - 1, len(gram) - 1))
    inverse[np.ix_(free, free)] = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return inverse


def _to_parameters(data: DelayData, structure: Structure, point: Point) -> FloatArray:
    """Return the matrix from the columns' coordinates to (a, b, h, constant, initial state).

    The columns s^(i) and -x' differ from dx/da_i and dx/dh by the free responses to their own initial values:
    moving a_i by 1 along s^(i) moves x^(l)(t_s) by s^(i+l)(t_s); moving h by 1 along -x' moves it by -x^(l+1)(t_s).
    """
    n = structure.order
    a = np.array(point.a)
    b, d = point.theta[0], point.theta[1]
    x = point.theta[2:]
    s = np.zeros(2 * n)
    for k in range(n):
        s[n + k] = a @ s[k : k + n] + x[k]
    tau = data.ty[0] - point.h
    row = int(np.searchsorted(data.tu, tau, side="right")) - 1
    u_s = data.u[row] if row >= 0 else (data.before or 0.0)
    if data.linear and row >= 0:
        u_s = float(np.interp(tau, data.tu, data.u))
    slopes = np.append(x[1:], a @ x + b * u_s + d)
    matrix = np.zeros((2 * n + 3, 2 * n + 3))  # columns: b, d, initial state, a, h
    matrix[:n, 2 + n : 2 + 2 * n] = np.eye(n)
    matrix[n, 0] = 1.0
    matrix[n + 1, 2 + 2 * n] = 1.0
    matrix[n + 2, [0, 1, 2 + n]] = -data.u_0, 1.0, -data.y_0
    matrix[n + 3 :, 2 : 2 + n] = np.eye(n)
    for i in range(n):
        matrix[n + 3 :, 2 + n + i] = s[i : i + n]
    matrix[n + 3 :, 2 + 2 * n] = -slopes
    return matrix


def colour_of(
    data: DelayData,
    structure: Structure,
    point: Point,
    *,
    max_order: int = MAX_AR,
    samples: NDArray[np.int64] | None = None,
    loaded: bool = False,
) -> NoiseColour:
    """Return the colour of the noise that a point leaves.

    Parameters
    ----------
    data : DelayData
        The rows that were fitted.
    structure : Structure
        Which parameters are free.
    point : Point
        The fit.
    max_order : int
        Largest order of the autoregression.
    samples : (N,) array, optional
        The sample that each row belongs to, ascending from 0: the colour is that of the means over samples.
    loaded : bool
        Whether a load may wander besides, as slowly as the plant's slowest lag, and come in where the command does.

    Returns
    -------
    NoiseColour
        Its freedom is that of the free ones of (a, b, h, constant, initial state).
    """
    columns = sensitivities(data, point.a, point.h, point.theta)
    to_free = _to_parameters(data, structure, point)[np.ix_(structure.free_parameters, structure.free)]
    in_parameters = np.linalg.solve(to_free.T, columns[:, structure.free].T).T
    rows = np.column_stack([in_parameters, residuals(data, point)])
    if samples is not None:
        first = np.flatnonzero(np.diff(samples, prepend=-1))
        rows = np.add.reduceat(rows, first) / np.diff(first, append=len(rows))[:, None]
    loads = _load_filters(data, point) if loaded else (WHITE,)
    return noise_colour(rows[:, :-1], rows[:, -1], max_order, loads)


def _load_filters(data: DelayData, point: Point) -> list[Whitening]:
    step = float(np.median(np.diff(data.ty)))
    own = np.roots([1.0, *(-value for value in point.a[::-1])]) * step
    own = own[np.abs(own.real) < _NOTHING_LEFT]
    # what lasts longer than the rows is told from a constant by none of them
    slowest = min((abs(one) for one in own if abs(one) > 1.0 / data.ty.size), default=1.0 / data.ty.size)
    slowest = min(slowest, math.pi)
    return load_filters(np.exp(np.append(own, -slowest)), slowest)


def widen_intervals(model: DelayModel, structure: Structure, colour: NoiseColour) -> DelayModel:
    """Return the model with standard deviations that, 1.96 times, make Student's 95 % intervals.

    Parameters
    ----------
    model : DelayModel
        As :func:`finish` left it.
    structure : Structure
        Which parameters are free.
    colour : NoiseColour
        Of the residual, with its degrees of freedom.
    """
    wider = np.ones(len(model.covariance))
    wider[structure.free_parameters] = colour.widening()
    return replace(model, covariance=model.covariance * np.outer(wider, wider))


def polish(
    data: DelayData,
    structure: Structure,
    start: Point,
    *,
    max_delay_s: float,
    coloured: bool = True,
    whitening: Whitening = WHITE,
) -> tuple[Point, NoiseColour]:
    """Fit from a starting point, find the noise's colour, fit again under it; return minimum and colour.

    Parameters
    ----------
    data : DelayData
        Rows that any delay up to ``max_delay_s`` can explain.
    structure : Structure
        Which parameters are free.
    start : Point
        Where to begin.
    max_delay_s : float
        Upper limit of h [s].
    coloured : bool
        Whether the noise may be coloured; white is assumed otherwise.
    whitening : Whitening
        Under which the fit begins: that of the noise which the starting point was found with.

    Raises
    ------
    IdentificationError
        Fewer rows than parameters, or a singular information matrix.
    """
    if data.ty.size < 3 * structure.parameters:
        raise IdentificationError(
            f"{data.ty.size} rows of y remain for {structure.parameters} parameters",
            where=data.name,
            remedy="record longer than the delay, or say what u was before the record",
        )
    point = minimise(
        data,
        structure,
        solve_linear(data, structure, start.a, start.h, whitening),
        max_delay_s=max_delay_s,
        whitening=whitening,
        iterations=50,
    )
    colour = colour_of(data, structure, point, max_order=0)
    for _ in range(3 if coloured else 0):
        found = colour_of(data, structure, point, loaded=True)
        if _alike(found.whitening, colour.whitening):
            break
        colour = found
        point = minimise(
            data,
            structure,
            solve_linear(data, structure, point.a, point.h, colour.whitening),
            max_delay_s=max_delay_s,
            whitening=colour.whitening,
        )
    return point, colour


def _alike(one: Whitening, other: Whitening) -> bool:
    pairs = ((one.ar, other.ar), (one.ma, other.ma))
    return all(a.size == b.size and np.max(np.abs(a - b), initial=0.0) < 1e-3 for a, b in pairs)


def _singular(data: DelayData, structure: Structure, point: Point, whitening: Whitening) -> IdentificationError:
    n, free = structure.order, np.flatnonzero(structure.free)
    information = normal_matrix(data, point.a, point.h, point.theta, True, whitening)[0][np.ix_(free, free)]
    names = ["b", "constant", *(f"x^({i})(t_s)" for i in range(n)), *(f"a{i}" for i in range(n)), "delay"]
    names = [name for name, free in zip(names, structure.free, strict=True) if free]
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    _, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    worst = [names[i] for i in np.argsort(-np.abs(vectors[:, 0]))[:3]]
    return IdentificationError(
        f"the record does not determine order {n}: {', '.join(worst)} cannot be told apart",
        where=data.name,
        remedy="ask for a lower order, or excite more frequencies: a step, or relay cycles at two more inserted delays",
    )
