"""Regions that count the structures which a record leaves open: other orders, other dead times.

The covariance of one model's numbers presumes that its structure is the true one. A loop that is hardly excited leaves
several open, whose responses differ by more than each one's own region says.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError
from autotune.identification.closed_loop.confidence import frequency_points
from autotune.identification.closed_loop.hold import without_hold, worthwhile
from autotune.identification.closed_loop.loop_excitation import critical_frequency
from autotune.identification.closed_loop.prediction_error import PredictionErrorEstimate
from autotune.points import FrequencyPoint, as_pairs

#: Band of a design's points, as multiples of the frequency at which the plant's phase has fallen to -135 degrees.
_LOWEST, _HIGHEST = 1.0 / 3.0, 2.0
#: Fewest points that a reduction can work with.
_FEWEST = 3

Weighted: TypeAlias = tuple[float, PredictionErrorEstimate]


@dataclass(frozen=True, kw_only=True, eq=False)
class Structures:
    """A chosen model, and others that the record leaves open.

    Attributes
    ----------
    chosen : PredictionErrorEstimate
        Polished model, one input and one output, in the recording's units.
    others : tuple of (float, PredictionErrorEstimate)
        Likewise, with their posterior probabilities; the chosen one has what is left to 1.
    """

    chosen: PredictionErrorEstimate
    others: tuple[Weighted, ...] = ()

    def probable(self, share: float) -> tuple[PredictionErrorEstimate, ...]:
        """Return the others that the most probable structures need to come to a share of the whole."""
        before, kept = 1.0 - sum(weight for weight, _ in self.others), []
        for weight, one in sorted(self.others, key=lambda pair: -pair[0]):
            if before >= share:
                break
            before += weight
            kept.append(one)
        return tuple(kept)

    def points(self, omega_rad_s: FloatArray) -> tuple[tuple[FrequencyPoint, ...], tuple[FrequencyPoint, ...]]:
        """Return G(exp(j omega Ts)) of the chosen model and points of its plant, with regions over all structures.

        Parameters
        ----------
        omega_rad_s : (W,) array
            Angular frequencies [rad/s].

        Returns
        -------
        response : tuple of FrequencyPoint
            At every frequency.
        plant : tuple of FrequencyPoint
            The command's hold taken out, where known to 50 %.
        """
        mine = frequency_points(self.chosen, omega_rad_s)
        others = [(weight, one.model, _response(one, omega_rad_s)) for weight, one in self.others]
        plants = [(weight, without_hold(model, points) if points else ()) for weight, model, points in others]
        response = _over(mine, [(weight, points) for weight, _, points in others])
        return response, worthwhile(_over(without_hold(self.chosen.model, mine), plants))

    def design_points(self, grid_rad_s: FloatArray) -> tuple[FrequencyPoint, ...]:
        """Return points of the plant that may be joined with measured ones and given to a design: as many as it takes.

        n points for n states, at least three, the command's hold taken out, evenly spread in log frequency from a third
        to twice the frequency at which the plant's phase is -135 degrees; those known to less than 50 % are left out.

        Parameters
        ----------
        grid_rad_s : (W,) array
            Ascending frequencies that the recording can speak of [rad/s].

        Notes
        -----
        A design takes points as independent. A model with 2 n numbers has a response that n complex values fix; more
        points of it would count the same data again. Among these few, errors still are correlated, which each region
        leaves out.
        """
        model, grid = self.chosen.model, np.asarray(grid_rad_s, dtype=np.float64)
        critical, _ = critical_frequency(grid, model.response(grid)[:, 0, 0], None)
        low = max(_LOWEST * critical, float(grid[0]))
        high = min(_HIGHEST * critical, float(grid[-1]), 0.49 * math.pi / model.sample_time_s)
        return self.points(np.geomspace(low, high, max(_FEWEST, model.order)))[1]


def _response(one: PredictionErrorEstimate, omega_rad_s: FloatArray) -> Sequence[FrequencyPoint]:
    """Return the response of a model, nothing where the record does not determine it: then it contradicts nothing."""
    try:
        return frequency_points(one, omega_rad_s)
    except IdentificationError:
        return ()


def _over(
    chosen: Sequence[FrequencyPoint], others: Sequence[tuple[float, Sequence[FrequencyPoint]]]
) -> tuple[FrequencyPoint, ...]:
    """Return points with the mean square error about them over all structures.

    References
    ----------
    Draper, J. R. Statist. Soc. B 57, 1995: the variance within structures and the variance between them.
    """
    own = 1.0 - sum(weight for weight, _ in others)
    tables = [(weight, {p.omega_rad_s: p for p in points}) for weight, points in others]
    result = []
    for point in chosen:
        there = [(w, table[point.omega_rad_s]) for w, table in tables if point.omega_rad_s in table]
        covariance, total = own * np.array(point.covariance), own
        for weight, other in there:
            away = other.response - point.response
            apart = np.array([away.real, away.imag])
            covariance, total = (
                covariance + weight * (np.array(other.covariance) + np.outer(apart, apart)),
                total + weight,
            )
        result.append(replace(point, covariance=as_pairs(covariance / total)))
    return tuple(result)
