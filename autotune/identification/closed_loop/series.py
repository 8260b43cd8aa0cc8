"""Data of one loop in one stretch or several: what lies between gaps is used together, each stretch with its own start.

Over a gap nothing is supposed. A stretch begins in a state of its own, which is estimated with the model: the errors
are linear in it, so for every model it is found exactly, and the steps move the model alone (variable projection, Golub
& Pereyra 1973).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.errors import IdentificationError
from autotune.identification.closed_loop.predictor_directions import Predictor
from autotune.identification.closed_loop.predictor_sweep import innovations, normal_equations

#: Directions of an initial state that carry less than this share of the information are not moved.
_RANK = 1e-12


@dataclass(frozen=True, kw_only=True, eq=False)
class Series:
    """Inputs and outputs, row by row, and where their stretches begin.

    Attributes
    ----------
    u, y : (N, n_u), (N, n_y) arrays
        Command as applied and measurement, equidistant within a stretch.
    starts : tuple of int
        First row of each stretch, 0 the first. Several only with one output.
    """

    u: FloatArray
    y: FloatArray
    starts: tuple[int, ...] = (0,)

    def __len__(self) -> int:
        return len(self.y)

    @property
    def is_cut(self) -> bool:
        """Whether there are several stretches."""
        return len(self.starts) > 1

    @property
    def slices(self) -> tuple[slice, ...]:
        """Rows of each stretch."""
        return tuple(slice(a, b) for a, b in zip(self.starts, (*self.starts[1:], len(self)), strict=True))

    @property
    def stretches(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Return u and y of each stretch."""
        return tuple((self.u[rows], self.y[rows]) for rows in self.slices)

    def head(self, rows: int) -> Series:
        """Return the first rows."""
        starts = tuple(start for start in self.starts if start < rows)
        return Series(u=self.u[:rows], y=self.y[:rows], starts=starts)

    def delayed(self, delay: int) -> Series:
        """Return the series with a dead time taken out, in each stretch: rows u(t - delay), y(t)."""
        if delay == 0:
            return self
        kept = [(u[: len(u) - delay], y[delay:]) for u, y in self.stretches if len(u) > delay >= 0]
        if not kept:
            raise IdentificationError(
                f"a dead time of {delay:g} rows in {len(self.y)}", remedy="give it in rows, fewer than were recorded"
            )
        starts = np.cumsum([0, *(len(y) for _, y in kept)])[:-1]
        u, y = (np.ascontiguousarray(np.concatenate(column)) for column in zip(*kept, strict=True))
        return Series(u=u, y=y, starts=tuple(int(start) for start in starts))

    def less(self, u: FloatArray, y: FloatArray) -> Series:
        """Return the series about an operating point.

        Parameters
        ----------
        u, y : (n_u,), (n_y,) arrays
            The operating point, taken off every row.
        """
        return replace(self, u=self.u - u, y=self.y - y)

    def states(self, predictor: Predictor) -> FloatArray:
        """Return the initial state of each stretch, (stretches, n): the predictor's own where there is one only."""
        if not self.is_cut:
            return predictor.x0[None]
        return np.array([_fit_state(predictor, u, y) for u, y in self.stretches])

    def errors(self, predictor: Predictor, states: FloatArray) -> FloatArray:
        """Return the innovations, (N, n_y), each stretch from its state.

        Parameters
        ----------
        predictor : Predictor
            Order n.
        states : (stretches, n) array
            Where each stretch begins.
        """
        parts = [
            innovations(predictor.F, predictor.H, x0, u, y) for x0, (u, y) in zip(states, self.stretches, strict=True)
        ]
        return np.concatenate(parts)

    def scatter(self, predictor: Predictor) -> FloatArray:
        """Return the sum of e e^T, (n_y, n_y), at the best initial states."""
        e = self.errors(predictor, self.states(predictor))
        # not by BLAS, whose threads spin longer than they work
        return np.asarray(np.einsum("to,tp->op", e, e), dtype=np.float64)

    def moving(self, predictor: Predictor, directions: FloatArray) -> FloatArray:
        """Return the directions that steps are taken along: none of initial states that are fitted stretch by stretch.

        Parameters
        ----------
        predictor : Predictor
            Whose parameters they change.
        directions : (entries, P) array
            All of them.
        """
        return directions[:, ~_of_state(predictor, directions)] if self.is_cut else directions

    def normal_equations(
        self,
        predictor: Predictor,
        phi: FloatArray,
        inner: FloatArray,
        directions: FloatArray,
        whitening: FloatArray,
    ) -> FloatArray:
        """Return the whitened normal equations along :meth:`moving`, the initial states found for every step.

        Parameters
        ----------
        predictor, phi, inner, whitening
            As in :func:`autotune.identification.closed_loop.predictor_sweep.normal_equations`.
        directions : (entries, P) array
            What ``inner`` was made from.
        """
        parts = [
            normal_equations(predictor.F, predictor.H, x0, u, y, phi, inner, whitening)
            for x0, (u, y) in zip(self.states(predictor), self.stretches, strict=True)
        ]
        if not self.is_cut:
            whole: FloatArray = parts[0]
            return whole
        of_state = np.append(_of_state(predictor, directions), False)
        return np.asarray(sum(_eliminate_state(part, of_state) for part in parts), dtype=np.float64)


def _of_state(predictor: Predictor, directions: FloatArray) -> BoolArray:
    """Return which directions are of the initial state; with one output they are of nothing else."""
    moves: BoolArray = np.any(directions[-len(predictor.x0) :] != 0.0, axis=0)
    return moves


def _fit_state(predictor: Predictor, u: FloatArray, y: FloatArray) -> FloatArray:
    """Return the initial state (n,) of a stretch with the least errors, corrected once for rounding."""
    n, entries = len(predictor.x0), predictor.packed().size
    inner = np.eye(entries, n, n - entries)
    nothing = np.zeros((0, predictor.F.shape[1]))
    inner = np.concatenate([np.zeros((0, n)), inner[predictor.F.size :]])
    x0 = np.zeros(n)
    for _ in range(2):
        total = normal_equations(predictor.F, predictor.H, x0, u, y, nothing, inner, np.eye(y.shape[1]))
        x0 = x0 - _inverse(total[:n, :n]) @ total[:n, n]
    return x0


def _eliminate_state(total: FloatArray, of_state: BoolArray) -> FloatArray:
    """Return the normal equations of the other columns, those of the state at their best for every step."""
    own, cross, rest = total[np.ix_(of_state, of_state)], total[np.ix_(~of_state, of_state)], ~of_state
    return np.asarray(total[np.ix_(rest, rest)] - cross @ _inverse(own) @ cross.T, dtype=np.float64)


def _inverse(information: FloatArray) -> FloatArray:
    """Return the inverse of an information matrix on what it says something about."""
    scale = np.sqrt(np.maximum(np.diag(information), np.finfo(np.float64).tiny))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    kept = values > _RANK * values[-1]
    return np.asarray((vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(scale, scale), dtype=np.float64)
