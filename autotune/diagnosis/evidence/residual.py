"""What a fit leaves, and how something missing would show in it: sent through the chain, freed of start states."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.signal import savgol_filter

from autotune.arrays import BoolArray, FloatArray, IntArray
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.diagnosis.fitting.noise import noise_from_differences
from autotune.diagnosis.simulation.chain import Chain
from autotune.diagnosis.simulation.simulator import Simulator
from autotune.models import Place

#: Least share of a function's power that the model's own numbers cannot imitate.
NEW = 1e-3
#: Ridge on unit columns while subsets are compared.
RIDGE = 1e-7
#: Half-width of the smoothing of residuals, in lags of the plant.
SMOOTH_LAGS = 0.25
#: Name of the one signal that is no quantity but a sign.
DIRECTION = "direction of the command"


class FreedResidual:
    """The residual of a fit, how a missing signal would show in it, and what held-out windows say of it."""

    def __init__(self, result: Fit, data: Data) -> None:
        self.result, self.data = result, data
        self.e = self.freed(result.e)
        self.J = self.freed(result.jacobian[0])
        #: What the model's own numbers explain: (N, p), orthonormal
        self.own = np.linalg.svd(self.J / np.maximum(np.linalg.norm(self.J, axis=0), 1e-300), full_matrices=False)[0]
        self.rows = data.rows
        # where the residual is so large that it was taken for noise, the floor is what changes from row to row alone
        jitter = noise_from_differences(result.residuals, data.good).total_sd / data.noise.total_sd
        self.floor = data.rows * min(1.0, jitter**2)
        number = np.zeros(result.e.size, dtype=np.int64)
        for i, (a, b) in enumerate(result.windows):
            number[a:b] = i
        # few windows may go by direction, one and one: blocks of two are taken
        self.first_half: BoolArray = (number // 2) % 2 == 0
        model = result.parametrisation.model
        self.unit = {"actuator": model.input.unit, "plant": model.plant_input_unit, "sensor": model.output.unit}
        self._ways: dict[Place, Simulator] = {"actuator": result.sim.driven_at(0), "plant": result.sim.driven_at(1)}

    def freed(self, direction: FloatArray) -> FloatArray:
        """Return a whitened direction, (N,) or (N, q), without what the windows' start states explain."""
        left = direction.copy()
        for (a, b), Q in zip(self.result.windows, self.result.states_explain, strict=True):
            left[a:b] -= Q @ (Q.T @ left[a:b])
        return left

    def shown(self, place: Place, missing: Sequence[FloatArray]) -> FloatArray:
        """Return how a missing signal, (N,) per recording, shows in the whitened residual, start states freed."""
        rows = []
        here = self.data.windows_here
        for r, s, ok, windows in zip(self.data.recordings, missing, self.data.good, here, strict=True):
            if place == "sensor":
                out = s
            else:
                driven = replace(r, u=s, extra={})
                rest = np.zeros(self.result.sim.order)
                out = self._ways[place].run(driven, rest, windows)[0][:, 0]
            rows.append(np.where(ok, out, 0.0))
        return self.freed(np.concatenate(self.data.whitened(rows)))

    def chain(self, place: Literal["actuator", "plant"]) -> Chain:
        """Return the linear chain from where something missing enters to the reading, in deviations."""
        return self._ways[place].chain

    def is_new(self, column: FloatArray) -> bool:
        """Whether a direction is more than what the model's own numbers can do."""
        left = self.beyond_numbers(column)
        return bool(left @ left > NEW * (column @ column))

    def beyond_numbers(self, direction: FloatArray) -> FloatArray:
        """Return a freed direction, (N,) or (N, q), without what the model's own numbers explain."""
        return np.asarray(direction - self.own @ (self.own.T @ direction))

    @cached_property
    def signals(self) -> dict[Place, dict[str, list[FloatArray]]]:
        """The signals that something missing may depend on, per place and recording; silent ones left out.

        Where the simulation is wrong its output is too: a position follows the readings, by the simulation plus its
        smoothed residual. A speed or level may not: a low-passed reading explains itself.
        """
        sim, data = self.result.sim, self.data
        out = [filled(s) for s in self.result.signals]
        command = [r.u - sim.u_offset for r in data.recordings]
        plant = {"level": [s[:, 2] for s in out], "plant input": [s[:, 3] for s in out]}
        if sim.chain.is_mechanical:
            lag = 1.0 / float(np.max(np.abs(np.linalg.eigvals(sim.chain.A[sim.chain.plant, sim.chain.plant]))))
            smooth = [
                _smoothed(e, a, b, round(SMOOTH_LAGS * lag / r.sample_time_s))
                for e, a, b, r in zip(self.result.residuals, data.starts, data.stops, data.recordings, strict=True)
            ]
            position = [s[:, 2] + e for s, e in zip(out, smooth, strict=True)]
            plant = {"speed": [s[:, 1] for s in out], "position": position, "plant input": plant["plant input"]}
        rate = [np.gradient(s[:, 0], r.t) for s, r in zip(out, data.recordings, strict=True)]
        named: dict[Place, dict[str, list[FloatArray]]] = {
            "plant": plant,
            "actuator": {"command": command, DIRECTION: [last_move(u) for u in command]},
            "sensor": {"reading": [s[:, 0] - sim.y_offset for s in out], "rate of the reading": rate},
        }
        return {
            p: {name: values for name, values in group.items() if np.ptp(np.concatenate(values)) > 0.0}
            for p, group in named.items()
        }

    def cross_validated(self, columns: FloatArray, penalty: FloatArray | None = None) -> float:
        """Return the squared error on each half of the windows with numbers fitted to the other half."""
        X = np.column_stack([self.J, columns])
        P = np.zeros((X.shape[1], X.shape[1]))
        if penalty is not None:
            P[self.J.shape[1] :, self.J.shape[1] :] = penalty
        total = 0.0
        for train in (self.first_half, ~self.first_half):
            beta = ridge(X[train], self.e[train], P)[0]
            left = self.e[~train] - X[~train] @ beta
            total += float(left @ left)
        return total

    def best_subset(self, columns: Sequence[FloatArray], size: int) -> tuple[float, tuple[int, ...]]:
        """Return the least cross-validated error of all subsets of a size, and the subset."""
        X, p = np.column_stack([self.J, *columns]), self.J.shape[1]
        norms = np.linalg.norm(X, axis=0)
        X = X / np.where(norms > 0.0, norms, 1.0)
        subsets = list(itertools.combinations(range(len(columns)), size))
        index = np.array([[*range(p), *(p + k for k in subset)] for subset in subsets])
        total = np.zeros(len(subsets))
        for train in (self.first_half, ~self.first_half):
            (H, g), (H_test, g_test) = ((X[h].T @ X[h], X[h].T @ self.e[h]) for h in (train, ~train))
            # a hair of ridge: what collinear functions share is theirs together
            H = H + RIDGE * np.eye(len(g))
            beta = np.linalg.solve(H[index[:, :, None], index[:, None, :]], g[index][..., None])[..., 0]
            test = H_test[index[:, :, None], index[:, None, :]]
            rest = self.e[~train]
            total += rest @ rest - 2.0 * np.sum(beta * g_test[index], axis=1)
            total += np.einsum("si,sij,sj->s", beta, test, beta)
        best = int(np.argmin(total))
        return float(total[best]), subsets[best]

    def explained(self, error: float, before: float) -> float:
        """Return the share of the held-out residual above the noise that is gone."""
        above = max(before - self.floor, self.data.thresholds.material * self.floor)
        return float(np.clip((before - error) / above, 0.0, 1.0)) if above > 0.0 else 0.0


def filled(signals: FloatArray) -> FloatArray:
    """Return simulated signals, (N, 4), rows outside all windows with what the nearest row before has, or the first."""
    return np.asarray(np.nan_to_num(signals[last_known(np.isfinite(signals[:, 0]))]))


def last_known(known: BoolArray) -> IntArray:
    """Return for every row the number of the nearest known one before, itself included, or of the first one."""
    return np.asarray(np.maximum.accumulate(np.where(known, np.arange(known.size), int(np.argmax(known)))))


def _smoothed(e: FloatArray, starts: IntArray, stops: IntArray, rows: int) -> FloatArray:
    """Return a residual smoothed within each window by local parabolas."""
    value = np.zeros_like(e)
    for a, b in zip(starts, stops, strict=True):
        width = min(max(7, 2 * rows + 1), (b - a - 1) // 2 * 2 + 1)
        if width >= 5:
            value[a:b] = savgol_filter(e[a:b], width, 2)
    return value


def last_move(u: FloatArray) -> FloatArray:
    """Return the sign of a signal's last change, 0 before the first."""
    sign = np.sign(np.diff(u, prepend=u[0]))
    last = np.maximum.accumulate(np.where(sign != 0.0, np.arange(u.size), 0))
    return np.asarray(sign[last])


def ridge(X: FloatArray, e: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the penalised least-squares estimate and the inverse of its normal matrix, null directions left at 0."""
    scale = np.linalg.norm(X, axis=0)
    scale[scale == 0.0] = 1.0
    H = (X / scale).T @ (X / scale) + P / np.outer(scale, scale)
    inverse = np.linalg.pinv(H, rcond=1e-7, hermitian=True) / np.outer(scale, scale)
    return np.asarray(inverse @ (X.T @ e)), np.asarray(inverse)


def shifts_by_window(result: Fit, i: int) -> FloatArray:
    """Return what one more step of fitting would make of one free number in every window alone, start states freed.

    Windows that do not feel it are left out.
    """
    J, shifts = result.jacobian[0][:, i], []
    for (a, b), Q in zip(result.windows, result.states_explain, strict=True):
        j, e = (d[a:b] - Q @ (Q.T @ d[a:b]) for d in (J, result.e))
        if float(j @ j) > 0.0:
            shifts.append(-float(j @ e) / float(j @ j))
    return np.array(shifts)
