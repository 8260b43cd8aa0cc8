"""Which combinations of parameters recordings determine, and which they do not: before anything is blamed.

The sensitivity of the readings to the parameters, in units of the noise and of the prior standard deviations, start
states projected out, has singular values s: along its right singular vector a recording narrows the belief from 1 to
1/sqrt(1 + s^2). Where s is below 1, the recording says less than the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.equations.fit_data import Fitted

#: A parameter belongs to a combination where its share of the direction's length is at least this.
_SHARE = 0.2
#: Width of the belief that recordings leave, over that before, from which on a combination is not determined.
LEFT = 0.5


@dataclass(frozen=True, kw_only=True)
class Combination:
    """A direction in the space of parameters.

    Attributes
    ----------
    parameters : tuple of str
        Those that move along it, the most first.
    changes : tuple of float
        Relative change of each while the first changes by 1 (absolute where a nominal value is 0).
    narrowed : float
        Standard deviation along it after the fit, over that of the prior: 1 where the recordings say nothing.
    """

    parameters: tuple[str, ...]
    changes: tuple[float, ...]
    narrowed: float

    @property
    def sentence(self) -> str:
        """What it says to a reader."""
        if len(self.parameters) == 1:
            return f"the recordings do not determine {self.parameters[0]}"
        moves = ", ".join(
            f"{name} {100 * 0.1 * change:+.2g} %" for name, change in zip(self.parameters, self.changes, strict=True)
        )
        names = ", ".join(self.parameters)
        return f"the recordings do not determine {names} apart: {moves} leaves the simulation as it is"


def combinations(fitted: Fitted, own: int | None = None) -> list[Combination]:
    """Return all directions of the parameters that were retuned, the least determined first.

    Parameters
    ----------
    fitted : Fitted
        The fit.
    own : int, optional
        How many of its parameters are the model's own ones, whatever else was fitted beside; all by default.
    """
    parameters, J = fitted.compiled.parameters[:own], fitted.jacobian
    moved = [i for i, p in enumerate(parameters) if p.spread > 0.0]
    believed = np.asarray(np.linalg.inv(J.T @ J + np.eye(J.shape[1])), dtype=np.float64)[np.ix_(moved, moved)]
    return combinations_by_certainty(
        believed, np.array([parameters[i].spread for i in moved]), [parameters[i].name for i in moved]
    )


def combinations_by_certainty(believed: FloatArray, spread: FloatArray, names: Sequence[str]) -> list[Combination]:
    """Return the directions of parameters by how well data determine them, the least determined first.

    Parameters
    ----------
    believed : (p, p) array
        Covariance of the parameters after the fit, in units of their prior standard deviations.
    spread : (p,) array
        Those standard deviations, relative.
    names : sequence of str
        Of the parameters.
    """
    if not names:
        return []
    information = np.linalg.pinv(believed, hermitian=True) - np.eye(len(names))
    values, vectors = np.linalg.eigh(information)
    found = []
    for value, vector in zip(values, vectors.T, strict=True):
        order = [i for i in np.argsort(-np.abs(vector)) if abs(vector[i]) >= _SHARE]
        changes = (vector * spread)[order]
        found.append(
            Combination(
                parameters=tuple(names[i] for i in order),
                changes=tuple(float(c) for c in changes / changes[0]),
                narrowed=float(1.0 / np.sqrt(1.0 + max(value, 0.0))),
            )
        )
    return found


def undetermined(found: Sequence[Combination]) -> list[Combination]:
    """Return the combinations along which the recordings hardly narrow the belief."""
    return [one for one in found if one.narrowed >= LEFT]
