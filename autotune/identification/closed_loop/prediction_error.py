"""Prediction-error polish of an innovation model: the estimate that reaches the Cramer-Rao bound.

From a consistent start (a subspace estimate) the determinant of the innovations' covariance is minimised over A, B, C,
D, K, the initial state and a constant, by Levenberg-Marquardt steps with the exact gradient. The initial state must be
free: with a controller of high gain at low frequency, residuals wrongly set to zero before the first row ruin the fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError
from autotune.identification.closed_loop.damped_step import damped_step, improve, log_determinant, whitened_equations
from autotune.identification.closed_loop.predictor_directions import (
    Predictor,
    behaviour_directions,
    constant_directions,
    regressors,
)
from autotune.identification.closed_loop.series import Series
from autotune.identification.closed_loop.state_space import InnovationModel, balancing

#: Rows that the initial state of the start is fitted on.
_LINEAR_ROWS = 2000
#: A search that could gain less than this is near enough to its end to tell whether a constant is missing.
_NEAR = 1.0
#: Means above this share of the motion are an operating point, about which everything is computed: far from it, the
#: constant and the dynamics hang together. A constant comes with it, for a sample mean is not the equilibrium. Smaller
#: means are left to the test: those of a slow loop stray by tenths of its motion, and a constant costs precision.
_OPERATING_POINT = 1.0
#: A constant that leaves less than this share of the start's innovations' variance is taken along from the beginning: a
#: search without it would go far away to explain it.
_EVIDENT_CONSTANT = 0.5
#: Smaller innovations, relative to the output, are rounding.
_NOISE_FREE = 1e-11
#: Innovations this small say that the record has no noise in it.
_ROUNDING = 1e-8


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictionErrorEstimate:
    """A polished model with the covariance of its behaviour.

    Attributes
    ----------
    model : InnovationModel
        The estimate, with the innovations' covariance (degrees of freedom counted).
    d_a, d_b, d_c, d_k : arrays of shape (..., P)
        Directions of the parameters: the model moves by their sum weighted with the coordinates.
    covariance : (P, P) array
        Asymptotic covariance of these coordinates (inverse information); right for Gaussian white innovations and
        a sufficient order, too small where the residuals are not white.
    offset_x, offset_y : (n,), (n_y,) arrays
        Constants of the state and the output equation: operating point.
    initial_states : (S, n) array
        Estimated state at the first row used of each stretch.
    rows : int
        Rows used.
    parameters : int
        Free parameters, initial state and constants counted.
    log_det : float
        Log determinant of the innovations' covariance, not corrected for degrees of freedom.
    iterations : int
        Accepted steps.
    converged : bool
        Whether the decrease predicted for the last step was less than the tolerance.
    condition : float
        Condition number of the information matrix with unit diagonal; 1 where there is no noise.
    noise_free : bool
        Whether the innovations are rounding: then K is arbitrary, and the covariance as good as zero.
    """

    model: InnovationModel
    d_a: FloatArray
    d_b: FloatArray
    d_c: FloatArray
    d_k: FloatArray
    covariance: FloatArray
    offset_x: FloatArray
    offset_y: FloatArray
    initial_states: FloatArray
    rows: int
    parameters: int
    log_det: float
    iterations: int
    converged: bool
    condition: float
    noise_free: bool

    @property
    def bic(self) -> float:
        """Bayesian information criterion, rows log det + parameters log rows; the smaller the better.

        The initial state counts in full: a superfluous mode near the unit circle uses it throughout the record. Those
        of further stretches count two each (Akaike 1974): what tells them does not grow with the record.
        """
        further = self.initial_states[1:].size
        return self.rows * self.log_det + (self.parameters - further) * float(np.log(self.rows)) + 2.0 * further


def prediction_error(
    start: InnovationModel,
    u: FloatArray,
    y: FloatArray,
    *,
    offset: bool = True,
    max_iterations: int = 60,
    starts: tuple[int, ...] = (0,),
) -> PredictionErrorEstimate:
    """Polish a start by minimising the determinant of the one-step prediction errors' covariance.

    Parameters
    ----------
    start : InnovationModel
        Consistent start; its order and dead time are kept. Its predictor must be stable, the plant need not be. D is
        zero in the estimate: y is measured before its row's u acts.
    u, y : (N, n_u), (N, n_y) arrays
        Command as applied and measurement, equidistant.
    offset : bool
        Estimate a constant where the signals move about an operating point or the data ask for one (a gain in -2 log
        likelihood above log N), so that means and an integrator's bias need not be known; a constant that is not there
        costs precision at low frequency.
    max_iterations : int
        Accepted steps after which the search ends unconverged.
    starts : tuple of int
        First row of each stretch of equidistant rows; several only with one output.

    Returns
    -------
    PredictionErrorEstimate

    Raises
    ------
    IdentificationError
        Fewer rows than parameters, or a start whose predictor is not stable.

    Notes
    -----
    The minimum found is the one in whose valley the start lies. Efficient for Gaussian innovations.
    """
    if start.predictor_radius >= 1.0:
        raise IdentificationError("the start's predictor is not stable", where="prediction error")
    series = Series(u=np.ascontiguousarray(u), y=np.ascontiguousarray(y), starts=starts).delayed(start.input_delay)
    u_level, y_level = (_level(column) if offset else np.zeros(column.shape[1]) for column in (series.u, series.y))
    series = series.less(u_level, y_level)
    prompt, n, n_y = replace(start, D=np.zeros_like(start.D)), start.order, y.shape[1]
    predictor = Predictor.of(prompt, np.zeros(n), np.zeros(n_y), np.zeros(n))
    predictor, evident = _linear_start(predictor, series, offset=offset)
    search = _search(
        predictor,
        series,
        offset=offset,
        constant=evident or bool(np.any(u_level) or np.any(y_level)),
        max_iterations=max_iterations,
    )
    return _estimate(start, search, series, u_level, y_level)


def _level(signal: FloatArray) -> FloatArray:
    """Return the operating point (channels,) that a signal moves about, zero where it moves about zero."""
    mean = signal.mean(axis=0)
    return np.where(np.abs(mean) > _OPERATING_POINT * signal.std(axis=0), mean, 0.0)


def _linear_start(predictor: Predictor, series: Series, *, offset: bool) -> tuple[Predictor, bool]:
    """Return the predictor with what its errors are linear in fitted, and whether a constant is evident.

    That is the initial state, where there is one only, and a constant where one is allowed and clearly there.
    """
    n, few = len(predictor.x0), series.head(_LINEAR_ROWS)
    entries = predictor.packed().size
    of_state = np.eye(entries, n, n - entries)
    prompt = predictor if few.is_cut else _solve_along(predictor, few, of_state)
    if not offset:
        return prompt, False
    loaded = _solve_along(predictor, few, np.hstack([of_state, constant_directions(predictor)]))
    fall = log_determinant(few.scatter(prompt)) - log_determinant(few.scatter(loaded))
    return (loaded, True) if fall > -math.log(_EVIDENT_CONSTANT) else (prompt, False)


def _solve_along(predictor: Predictor, series: Series, directions: FloatArray) -> Predictor:
    """Return the predictor at the least squares along directions that its errors are linear in."""
    one = np.eye(predictor.F.shape[1])[-1:]  # the regressor of a load; the state has none
    total = whitened_equations(predictor, directions, series, series.scatter(predictor), one)
    step = damped_step(total[:-1, :-1], total[:-1, -1], 0.0)[0]
    return predictor.move_along(step, series.moving(predictor, directions))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    predictor: Predictor
    directions: FloatArray
    information: FloatArray
    scatter: FloatArray
    iterations: int
    converged: bool

    def noise_free(self, y: FloatArray) -> bool:
        """Return whether the innovations of the outputs are rounding."""
        return bool(np.all(np.diag(self.scatter) <= len(y) * (_ROUNDING * np.std(y, axis=0)) ** 2))


def _search(
    predictor: Predictor,
    series: Series,
    *,
    offset: bool,
    constant: bool,
    max_iterations: int,
) -> _Search:
    """Search from a predictor, without a constant, if none is given, until near the end the score test asks for one."""
    damping, iterations, converged = 0.0, 0, False
    errors, y = series.scatter(predictor), series.y
    floor = len(y) * (_NOISE_FREE * np.std(y, axis=0)) ** 2
    n_y = y.shape[1]
    while True:
        renewed = iterations % 5 == 0
        if renewed:
            predictor = _balance(predictor)
        if renewed or n_y > 1:  # with one output they hold as long as the coordinates do
            full = behaviour_directions(predictor, offset=offset)
            directions, phi = series.moving(predictor, full), regressors(predictor)
        parameters = full.shape[1] + (len(series.starts) - 1) * len(predictor.x0)
        if len(y) * n_y <= parameters:
            raise IdentificationError(
                f"the record is too short: {len(y)} rows for {parameters} parameters",
                remedy="record longer, or ask for a lower order",
            )
        total = whitened_equations(predictor, full, series, errors, phi)
        used = directions.shape[1] - (n_y if offset and not constant else 0)
        information, gradient = total[:used, :used], total[:used, -1]
        converged = bool(np.all(np.diag(errors) <= floor))
        if converged or iterations == max_iterations:
            break
        ahead = improve(predictor, directions[:, :used], information, gradient, errors, series, damping)
        if offset and not constant and ahead.predicted < _NEAR:
            gain = damped_step(total[:-1, :-1], total[:-1, -1], 0.0)[1] - ahead.predicted
            constant = gain > n_y * math.log(len(y))  # what the Bayesian criterion asks of n_y parameters
            if constant:
                damping = 0.0
                continue
        damping, converged = ahead.damping, ahead.converged
        if ahead.predictor is None:
            break
        predictor, errors, iterations = ahead.predictor, ahead.errors, iterations + 1
    return _Search(
        predictor=predictor,
        directions=directions[:, :used],
        information=information,
        scatter=errors,
        iterations=iterations,
        converged=converged,
    )


def _balance(predictor: Predictor) -> Predictor:
    """Return the predictor in balanced coordinates, in which no direction is badly scaled."""
    n = len(predictor.x0)
    A, B, K, C, _ = predictor.matrices
    T = balancing(A, np.hstack([B, K]), C)
    inverse = np.linalg.inv(T)
    F, H = T @ predictor.F, predictor.H.copy()
    F[:, :n] = F[:, :n] @ inverse
    H[:, :n] = C @ inverse
    return Predictor(F=F, H=H, x0=T @ predictor.x0)


def _estimate(
    start: InnovationModel, search: _Search, series: Series, u_level: FloatArray, y_level: FloatArray
) -> PredictionErrorEstimate:
    predictor, rows, states = search.predictor, len(series), series.states(search.predictor)
    n, n_u, n_y = predictor.sizes
    P = search.directions.shape[1]
    parameters = P + (states.size if series.is_cut else 0)
    d_f, d_h, _ = np.split(search.directions, np.cumsum([predictor.F.size, predictor.H.size]))
    d_f, d_h = d_f.reshape(*predictor.F.shape, P), d_h.reshape(*predictor.H.shape, P)
    A, B, K, C, D = predictor.matrices
    d_k = d_f[:, n + n_u : n + n_u + n_y]
    feedback = np.einsum("iop,or->irp", d_k, predictor.H) + np.einsum("io,orp->irp", K, d_h)  # of K H
    freedom = rows - parameters / n_y
    noise_free = search.noise_free(series.y)
    scale = np.sqrt(np.maximum(np.diag(search.information), np.finfo(np.float64).tiny))
    values, vectors = np.linalg.eigh(search.information / np.outer(scale, scale))
    kept = values > 1e-14 * values[-1]
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(scale, scale)
    model = replace(
        start,
        A=A + K @ C,
        B=B + K @ D,
        C=C,
        D=D,
        K=K,
        innovation_covariance=search.scatter / freedom,
    )
    return PredictionErrorEstimate(
        model=model,
        d_a=d_f[:, :n] + feedback[:, :n],
        d_b=d_f[:, n : n + n_u] + feedback[:, n : n + n_u],
        d_c=d_h[:, :n],
        d_k=d_k,
        covariance=inverse * rows / freedom,
        offset_x=predictor.F[:, -1] + K @ predictor.H[:, -1] - model.B @ u_level,
        offset_y=predictor.H[:, -1] + y_level - D @ u_level,
        initial_states=states,
        rows=rows,
        parameters=parameters,
        log_det=log_determinant(search.scatter / rows),
        iterations=search.iterations,
        converged=search.converged,
        condition=1.0 if noise_free else float(values[-1] / max(values[0], 1e-300 * values[-1])),
        noise_free=noise_free,
    )
