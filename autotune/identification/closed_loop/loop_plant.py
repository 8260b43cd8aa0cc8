"""The plant of an identified loop with its whole covariance: what a design keeps its margins on.

Points of an identified response are correlated: few numbers fix them all. Taken as independent they leave out what the
data say of them together, and which plants lie within all of their regions without being compatible with the data.
Here the numbers themselves, the coefficients of numerator and denominator in z, span the region.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.identification.closed_loop.hold import continuous_form
from autotune.identification.closed_loop.prediction_error import PredictionErrorEstimate
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.identification.parametric import PlantFit
from autotune.models import TransferFunction

#: Halvings of a step from the estimate until the plant there has a continuous form.
_HALVINGS = 40


def loop_plant(estimate: PredictionErrorEstimate) -> PlantFit | None:
    """Return the continuous plant under the command's hold, and the joint region of its coefficients.

    Parameters
    ----------
    estimate : PredictionErrorEstimate
        Polished model, one input and one output, in the recording's units.

    Returns
    -------
    PlantFit or None
        Parameters are b_0, ..., b_n, a_1, ..., a_n in ascending powers of the delay operator, b_0 only with
        feedthrough; None where the model is that of no held continuous plant (a pole on the negative real axis).

    Notes
    -----
    The order is taken as known. A plant of the region that has no continuous form is replaced by the one on the way
    from the estimate that has.
    """
    model = estimate.model
    values = _coefficients(model)
    plant = _continuous(model, values)
    if plant is None or not np.all(np.isfinite(estimate.covariance)):
        return None
    jacobian = _jacobian(estimate)
    kept = np.linalg.norm(jacobian, axis=1) > 0.0

    def build(parameters: FloatArray) -> TransferFunction:
        for halved in range(_HALVINGS):
            found = _continuous(model, values + (parameters - values) * 0.5**halved)
            if found is not None:
                return found
        return plant

    def of_free(free: FloatArray) -> TransferFunction:
        whole = values.copy()
        whole[kept] = free
        return build(whole)

    size = int(kept.sum())
    return PlantFit(
        plant=plant,
        integrating=False,
        parameters=values[kept],
        covariance=(jacobian @ estimate.covariance @ jacobian.T)[np.ix_(kept, kept)],
        sign=1 if plant.num[-1] * plant.den[-1] >= 0.0 else -1,
        chi_square=float(estimate.rows - estimate.parameters),
        degrees_of_freedom=estimate.rows - estimate.parameters,
        bounds=np.array([[-np.inf] * size, [np.inf] * size]),
        build=of_free,
        source="recording",
    )


def _coefficients(model: InnovationModel) -> FloatArray:
    num, den = replace(model, input_delay=0).polynomials()
    return np.concatenate([num, den[1:]])


def _jacobian(estimate: PredictionErrorEstimate) -> FloatArray:
    """Return the derivatives of the coefficients by the coordinates of the estimate."""
    model, P = estimate.model, len(estimate.covariance)
    sd = np.sqrt(np.maximum(np.diag(estimate.covariance), 0.0))
    columns = []
    for p in range(P):
        step = 1e-3 * sd[p] or 1e-9
        beside = [
            _coefficients(
                replace(
                    model,
                    A=model.A + way * estimate.d_a[..., p],
                    B=model.B + way * estimate.d_b[..., p],
                    C=model.C + way * estimate.d_c[..., p],
                    D=model.D + way * estimate.d_d[..., p],
                )
            )
            for way in (-step, step)
        ]
        columns.append((beside[1] - beside[0]) / (2.0 * step))
    return np.column_stack(columns)


def _continuous(model: InnovationModel, coefficients: FloatArray) -> TransferFunction | None:
    """Return the plant with these samples under a held input, None where there is none."""
    n = model.order
    num, den = coefficients[: n + 1], np.concatenate([[1.0], coefficients[n + 1 :]])
    A = np.eye(n, k=1)
    A[-1] = -den[:0:-1]
    C = (num[1:] - num[0] * den[1:])[::-1][None]
    companion = replace(model, A=A, B=np.eye(n)[:, -1:], C=C, D=num[:1, None], K=np.zeros((n, 1)))
    form = continuous_form(companion)
    if form is None:
        return None
    F, G = form
    poly = np.real(np.poly(F))
    rank_one = np.real(np.poly(F - G @ C))
    top = rank_one - poly + num[0] * poly
    top = np.trim_zeros(np.where(np.abs(top) > 1e-12 * np.max(np.abs(top)), top, 0.0), "f")
    if not top.size:
        return None
    return TransferFunction(
        num=tuple(top.tolist()), den=tuple(poly.tolist()), delay_s=model.input_delay * model.sample_time_s
    )
