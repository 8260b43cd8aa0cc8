"""Where a sweep dwells whose points are estimated together: at the limit cycle whose next period tells most of all.

What a period tells is the Fisher information of a rough model, k exp(-j omega L) / ((j omega + a) (1 + j omega tau)),
of which all four numbers are taken as unknown. In the middle of the band it is little, at the ends it is much.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.experiment.local_model import LocalModel

#: time constant, in 1/omega of the band's middle, below which a lag could not be told from a dead time
_LEAST = 0.05
_MOST_PERIODS = 1000


@dataclass(frozen=True, kw_only=True)
class Dwell:
    """Whole periods at one limit cycle.

    Attributes
    ----------
    omega_rad_s : float
        Its frequency [rad/s].
    signal : float
        Amplitude of y's fundamental over the noise's standard deviation.
    periods : int
        How many, run or to be run.
    """

    omega_rad_s: float
    signal: float
    periods: int

    @property
    def period_s(self) -> float:
        """Length of a period [s]."""
        return 2.0 * math.pi / self.omega_rad_s


def further_periods(
    run: Sequence[Dwell],
    choices: Sequence[Dwell],
    model: LocalModel,
    sample_time_s: float,
    *,
    factor: float,
    left_s: float,
) -> tuple[int, ...]:
    """Return how many further periods each choice needs, the least that it can have among them.

    Parameters
    ----------
    run : sequence of Dwell
        Finished limit cycles.
    choices : sequence of Dwell
        Limit cycles that may be run, with the least periods that an estimate needs.
    model : LocalModel
        The rough model.
    sample_time_s : float
        Control period [s].
    factor : float
        What the largest standard deviation is to be multiplied by, of what it is after ``run``; below 1.
    left_s : float
        Rig time that is left [s].

    Returns
    -------
    tuple of int
        For each choice, 0 where it is not needed or does not fit into the time.
    """
    band = np.array([one.omega_rad_s for one in (*run, *choices)])
    grid = np.geomspace(band.min(), band.max(), 9)
    model = replace(model, tau_s=max(model.tau_s, _LEAST / float(grid[4])))
    each = [_information(one.omega_rad_s, one.signal, one.period_s / sample_time_s, model) for one in choices]
    begun = [_information(one.omega_rad_s, one.signal, one.period_s / sample_time_s, model) for one in run]
    information = np.sum([one.periods * own for one, own in zip(run, begun, strict=True)], axis=0)
    wanted = factor * _worst(information, grid, model)
    periods = [0] * len(choices)
    for _ in range(_MOST_PERIODS):
        before = _worst(information, grid, model)
        if before <= wanted:
            break
        best, gained, more = -1, 0.0, 0
        for i, choice in enumerate(choices):
            step = 1 if periods[i] else choice.periods
            if step * choice.period_s > left_s:
                continue
            rate = math.log(before / _worst(information + step * each[i], grid, model)) / (step * choice.period_s)
            if rate > gained:
                best, gained, more = i, rate, step
        if best < 0:
            break
        periods[best] += more
        left_s -= more * choices[best].period_s
        information = information + more * each[best]
    return tuple(periods)


def _slopes(omega_rad_s: FloatArray, model: LocalModel) -> FloatArray:
    """Return the derivatives of the response's logarithm, log gain and phase, by (log k, a, tau, L), (..., 2, 4)."""
    s = 1j * np.asarray(omega_rad_s, dtype=np.float64)
    slopes = np.stack([np.ones_like(s), -1.0 / (s + model.a_rad_s), -s / (1.0 + s * model.tau_s), -s], axis=-1)
    return np.stack([slopes.real, slopes.imag], axis=-2)


def _information(omega_rad_s: float, signal: float, samples: float, model: LocalModel) -> FloatArray:
    """Return the information of a period's fundamental, whose gain and phase have variances 2 / (samples signal^2)."""
    J = _slopes(np.array([omega_rad_s]), model)[0]
    return np.asarray(0.5 * samples * signal**2 * J.T @ J, dtype=np.float64)


def _worst(information: FloatArray, omega_rad_s: FloatArray, model: LocalModel) -> float:
    """Return the largest standard deviation of a gain, or of a phase in hundreds of degrees, at the frequencies."""
    scale = 1.0 / np.sqrt(np.diag(information))
    covariance = scale[:, None] * np.linalg.pinv(information * np.outer(scale, scale), rcond=1e-10) * scale
    J = _slopes(omega_rad_s, model)
    sd = np.sqrt(np.einsum("wip,pq,wiq->wi", J, covariance, J))
    return float(max(sd[:, 0].max(), math.degrees(sd[:, 1].max()) / 100.0))
