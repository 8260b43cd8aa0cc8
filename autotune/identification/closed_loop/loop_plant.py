"""The plant of an identified loop with its whole covariance: what a design keeps its margins on.

Points of an identified response are correlated: few numbers fix them all. Taken as independent they leave out what the
data say of them together, and which plants lie within all of their regions without being compatible with the data.
Here the numbers themselves, the coefficients of numerator and denominator in z, span the region.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from autotune.arrays import FloatArray
from autotune.errors import InputError
from autotune.identification.closed_loop.hold import continuous_form
from autotune.identification.closed_loop.prediction_error import PredictionErrorEstimate
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.identification.closed_loop.structures import Structures
from autotune.identification.parametric import PlantFit
from autotune.models import TransferFunction
from autotune.schema import Number, Section, Time, validate
from autotune.text_files import read_json

#: Halvings of a step from the estimate until the plant there has a continuous form.
_HALVINGS = 40
#: Highest order that a file may have, and other structures.
_MOST_ORDER, _MOST_OTHERS = 60, 200
#: Probability that the structures have together which a design keeps its margins on.
PROBABLE = 0.95


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopRegion:
    """Coefficients of an identified loop's plant with their joint covariance.

    Attributes
    ----------
    num : (n + 1,) array
        b_0, ..., b_n in ascending powers of the delay operator, dead time left out.
    den : (n + 1,) array
        1, a_1, ..., a_n likewise.
    input_delay : int
        Dead time in whole samples.
    sample_time_s : float
        Sample time [s].
    free : (P,) tuple of int
        Which of b_0, ..., b_n, a_1, ..., a_n, counted from 0, were estimated.
    covariance : (P, P) array
        Of those.
    degrees_of_freedom : int
        Rows less parameters.
    others : tuple of LoopRegion
        Of other orders and dead times that the record leaves open.
    """

    num: FloatArray
    den: FloatArray
    input_delay: int
    sample_time_s: float
    free: tuple[int, ...]
    covariance: FloatArray
    degrees_of_freedom: int
    others: tuple[LoopRegion, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return what ``closed_loop.json`` holds as ``plant_region``."""
        others = {"others": [one.to_json() for one in self.others]} if self.others else {}
        return others | {
            "num": self.num.tolist(),
            "den": self.den.tolist(),
            "input_delay": self.input_delay,
            "sample_time_s": self.sample_time_s,
            "free": list(self.free),
            "covariance": self.covariance.tolist(),
            "degrees_of_freedom": self.degrees_of_freedom,
        }

    def plant_fit(self) -> PlantFit | None:
        """Return the continuous plant under the command's hold, and its region.

        Returns
        -------
        PlantFit or None
            None where the model is that of no held continuous plant (a pole on the negative real axis).

        Notes
        -----
        A plant of the region that has no continuous form is replaced by the one on the way from the estimate that has.
        Other structures are there with their estimates alone. Their own regions are widest where a pole lies beside a
        zero, which no loop feels, and would have static gains of both signs.
        """
        values, kept = np.concatenate([self.num, self.den[1:]]), list(self.free)
        plant = self._continuous(values)
        if plant is None:
            return None

        def of_free(free: FloatArray) -> TransferFunction:
            whole = values.copy()
            whole[kept] = free
            for halved in range(_HALVINGS):
                found = self._continuous(values + (whole - values) * 0.5**halved)
                if found is not None:
                    return found
            return plant

        size = len(kept)
        return PlantFit(
            plant=plant,
            integrating=False,
            parameters=values[kept],
            covariance=self.covariance,
            sign=1 if plant.num[-1] * plant.den[-1] >= 0.0 else -1,
            chi_square=float(self.degrees_of_freedom),
            degrees_of_freedom=self.degrees_of_freedom,
            bounds=np.array([[-np.inf] * size, [np.inf] * size]),
            build=of_free,
            others=tuple(
                replace(fit, covariance=np.zeros_like(fit.covariance))
                for one in self.others
                if (fit := one.plant_fit()) is not None
            ),
            source="recording",
        )

    def _continuous(self, coefficients: FloatArray) -> TransferFunction | None:
        """Return the plant with these samples under a held input, None where there is none."""
        n = len(self.den) - 1
        num, den = coefficients[: n + 1], np.concatenate([[1.0], coefficients[n + 1 :]])
        A = np.eye(n, k=1)
        A[-1] = -den[:0:-1]
        C = (num[1:] - num[0] * den[1:])[::-1][None]
        companion = InnovationModel(
            A=A, B=np.eye(n)[:, -1:], C=C, D=num[:1, None], K=np.zeros((n, 1)), innovation_covariance=np.zeros((1, 1)),
            sample_time_s=self.sample_time_s, input_delay=self.input_delay,
        )  # fmt: skip
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
            num=tuple(top.tolist()), den=tuple(poly.tolist()), delay_s=self.input_delay * self.sample_time_s
        )


def loop_region(found: Structures) -> LoopRegion | None:
    """Return the coefficients of the plant with their joint covariance; None where the covariance is not finite.

    Parameters
    ----------
    found : Structures
        The chosen model; of the others those count that the record's most probable ones need to come to 95 %.
    """
    region = _region(found.chosen)
    if region is None:
        return None
    others = (_region(one) for one in found.probable(PROBABLE))
    return replace(region, others=tuple(one for one in others if one is not None))


def _region(estimate: PredictionErrorEstimate) -> LoopRegion | None:
    if not np.all(np.isfinite(estimate.covariance)):
        return None
    model = estimate.model
    values, jacobian = _coefficients(model), _jacobian(estimate)
    kept = np.linalg.norm(jacobian, axis=1) > 0.0
    return LoopRegion(
        num=values[: model.order + 1],
        den=np.concatenate([[1.0], values[model.order + 1 :]]),
        input_delay=model.input_delay,
        sample_time_s=model.sample_time_s,
        free=tuple(int(i) for i in np.flatnonzero(kept)),
        covariance=(jacobian @ estimate.covariance @ jacobian.T)[np.ix_(kept, kept)],
        degrees_of_freedom=estimate.rows - estimate.parameters,
    )


def loop_plant(found: Structures) -> PlantFit | None:
    """Return the continuous plant of an identified loop and the joint region of its coefficients.

    Parameters
    ----------
    found : Structures
        As for :func:`loop_region`.

    Returns
    -------
    PlantFit or None
        As :meth:`LoopRegion.plant_fit`; None also where the covariance is not finite.
    """
    region = loop_region(found)
    return None if region is None else region.plant_fit()


class _Region(Section):
    """Keys of ``plant_region``."""

    num: Annotated[tuple[Number, ...], Field(min_length=2, max_length=_MOST_ORDER + 1)]
    den: Annotated[tuple[Number, ...], Field(min_length=2, max_length=_MOST_ORDER + 1)]
    input_delay: Annotated[int, Field(ge=0, le=100_000)]
    sample_time_s: Time
    free: Annotated[tuple[int, ...], Field(min_length=1, max_length=2 * _MOST_ORDER + 1)]
    covariance: Annotated[tuple[tuple[Number, ...], ...], Field(min_length=1, max_length=2 * _MOST_ORDER + 1)]
    degrees_of_freedom: Annotated[int, Field(ge=1)]
    others: Annotated[tuple[_Region, ...], Field(max_length=_MOST_OTHERS)] = ()

    @model_validator(mode="after")
    def _fits(self) -> _Region:
        n, size = len(self.den) - 1, len(self.free)
        if len(self.num) != n + 1 or self.den[0] != 1.0:
            raise ValueError("num must be as long as den, and den begin with 1")
        if sorted(set(self.free)) != list(self.free) or not 0 <= self.free[0] <= self.free[-1] <= 2 * n:
            raise ValueError(f"free must be ascending numbers of coefficients, 0 to {2 * n}")
        if len(self.covariance) != size or any(len(row) != size for row in self.covariance):
            raise ValueError(f"covariance must be a {size} x {size} matrix, as free has {size} entries")
        matrix = np.array(self.covariance)
        scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
        if not np.all(scale > 0.0) or not np.all(np.isfinite(matrix)):
            raise ValueError("the diagonal of covariance must be positive")
        matrix = matrix / np.outer(scale, scale)
        if not np.allclose(matrix, matrix.T, atol=1e-6) or np.linalg.eigvalsh(matrix)[0] < -1e-6:
            raise ValueError("covariance must be symmetric and positive semi-definite")
        return self


def read_loop_region(path: str | os.PathLike[str]) -> LoopRegion | None:
    """Return the region that ``closed_loop.json`` holds; None for a file without one.

    Raises
    ------
    InputError
        Not JSON, or a ``plant_region`` that is not complete; names the key.
    """
    content = read_json(path)
    region = content.get("plant_region") if isinstance(content, dict) else None
    if region is None:
        return None
    where = f"{path} plant_region"
    if not isinstance(region, dict):
        raise InputError("is no table of keys", where=where, remedy="write it with autotune identify closed-loop")
    return _as_region(validate(_Region, region, where))


def _as_region(found: _Region) -> LoopRegion:
    return LoopRegion(
        num=np.array(found.num),
        den=np.array(found.den),
        input_delay=found.input_delay,
        sample_time_s=found.sample_time_s,
        free=found.free,
        covariance=np.array(found.covariance),
        degrees_of_freedom=found.degrees_of_freedom,
        others=tuple(_as_region(one) for one in found.others),
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
                )
            )
            for way in (-step, step)
        ]
        columns.append((beside[1] - beside[0]) / (2.0 * step))
    return np.column_stack(columns)
