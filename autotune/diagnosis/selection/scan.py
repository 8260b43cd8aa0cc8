"""What a direct search for starting values sees: recordings under a fit, first-order predictions, lines of spectra."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.signal import fftconvolve, lfilter

from autotune.arrays import FloatArray, IntArray
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import RUNAWAY, Fit
from autotune.diagnosis.fitting.parameters import effect_with
from autotune.diagnosis.fitting.windows import model_lag_s
from autotune.diagnosis.selection.prediction import direction, predictions, signal_sizes
from autotune.effects import kind_of
from autotune.effects.base import FEW_LEVELS, SignalSizes
from autotune.models import Effect
from autotune.recording import Recording

#: Largest factor of a change that is predicted.
LARGEST_SCALE = 4.0


@dataclass(frozen=True, kw_only=True, eq=False)
class FitScan:
    """The recordings under a fit, as an effect's direct search sees them.

    Attributes
    ----------
    name : str
        The effect that is looked for.
    base : Fit
        What it is added to.
    data : Data
        Recordings.
    pool : Executor
        Where simulations run.
    """

    name: str
    base: Fit
    data: Data
    pool: Executor

    @cached_property
    def sizes(self) -> SignalSizes:
        """Sizes of the signals."""
        return signal_sizes(self.base, self.data)

    @property
    def durations_s(self) -> Sequence[float]:
        """Length of every recording [s]."""
        return [r.duration_s for r in self.data.driving]

    @property
    def slowest_lag_s(self) -> float:
        """Slowest time constant of the nominal chain [s]."""
        return model_lag_s(self.base.parametrisation.model)

    def predicted(self, values: Sequence[tuple[float, ...]]) -> list[tuple[float, tuple[float, ...]]]:
        """Return the decrease of chi-square that the first order predicts for the effect with each set of values.

        Beside it stand the values with their amplitudes made as small as the first order needs them.
        """
        found = self.pool.map(lambda v: predictions(self.base, effect_with(self.name, v), self.data)[0], values)
        return [(one.decrease, tuple(q.value for q in one.effect.parameters.values())) for one in found]

    def together(self, values: Sequence[tuple[float, ...]]) -> tuple[float, FloatArray]:
        """Return the decrease that sets of values predict together, and the factor of each of them."""
        try:
            D = np.column_stack([direction(self.base, effect_with(self.name, v), self.data) for v in values])
        except RUNAWAY:
            return 0.0, np.eye(1, len(values))[0]
        a = np.linalg.lstsq(D.T @ self.base.without_numbers(D), -D.T @ self.base.e)[0]
        return float(-self.base.e @ D @ a), np.asarray(a)

    def lines_over_time(self) -> tuple[FloatArray, FloatArray]:
        """Return frequencies [Hz] and the decrease of chi2 that a sinusoid common to all recordings brings at each.

        Phases count from each recording's start, so that one load swings through all of them coherently. Rows are
        taken as equidistant, which is good enough for a starting value.
        """
        data = self.data
        size = 4 * int(2 ** np.ceil(np.log2(max(len(r) for r in data.driving))))
        total = np.zeros(size // 2 + 1, dtype=np.complex128)
        for i, e in enumerate(self.base.whitened):
            at_its_time = np.zeros(size)
            at_its_time[data.kept[i] if data.kept else slice(e.size)] = e
            total += np.fft.rfft(at_its_time)
        rows = sum(len(r) for r in data.driving)
        return np.asarray(np.fft.rfftfreq(size, data.sample_times[0])), np.asarray(2.0 * np.abs(total) ** 2 / rows)

    @cached_property
    def _answer(self) -> FloatArray:
        """Whitened answer of the chain to a command of one row, as long as the longest window.

        The chain alone answers, its effects left aside, and rows are taken as equidistant: good enough to start from.
        """
        data, sim = self.data, self.base.sim
        longest = max(int(np.max(b - a)) for a, b in zip(data.starts, data.stops, strict=True))
        pulse = np.zeros(longest + 1)
        pulse[1] = 1.0  # what stands in the first row has stood before it
        dt = data.sample_times[0]
        still = replace(sim.linear(), linear_hold=False)
        struck = Recording(t=dt * np.arange(longest + 1, dtype=np.float64), u=sim.u_offset + pulse, y=0.0 * pulse)
        answer = still.run(struck, np.zeros(sim.order))[0][1:, 0]
        return np.asarray(lfilter([1.0, *(-a for a in data.noise.ar)], [1.0], answer - sim.y_offset) / data.noise.sd)

    def influence(self) -> tuple[FloatArray, FloatArray]:
        """Return the commands inside the windows, and how chi2 would fall with more of each: -0.5 d chi2/du."""
        data, answer = self.data, self._answer
        commands, influence = [], []
        for r, e, starts, stops in zip(data.recordings, self.base.whitened, data.starts, data.stops, strict=True):
            for a, b in zip(starts, stops, strict=True):
                commands.append(r.u[a:b])
                influence.append(fftconvolve(e[a:b], answer[: b - a][::-1])[b - a - 1 :])
        return np.concatenate(commands), np.concatenate(influence)

    @cached_property
    def commands(self) -> FloatArray:
        """Commands in the recordings."""
        return np.concatenate([r.u for r in self.data.recordings])

    @property
    def operating_command(self) -> float:
        """Command at the nominal operating point."""
        return self.base.parametrisation.model.input.offset

    def commanded(self, changes: FloatArray) -> FloatArray:
        """Return the decrease of chi2 that changes of the commands predict.

        Parameters
        ----------
        changes : (K, L) array
            What is added to each of the L different commands, smallest first, in each of K trials.

        Returns
        -------
        (K,) array
            Decrease of |e + a d|^2 over 0 <= a <= 4, with d freed of what start states and numbers explain. Linear in
            the chain: first order in the change.
        """
        few = self._few_levels
        if few is not None:
            slope, curvature = changes @ few[0], np.einsum("ij,ij->i", changes @ few[1], changes)
        else:
            moved = self._moved(changes[:, self._numbered[1]])
            slope, curvature = moved @ self.base.e, np.einsum("ij,ji->i", moved, self.base.without_numbers(moved.T))
        a = np.clip(slope / np.maximum(curvature, 1e-300), 0.0, LARGEST_SCALE)
        return np.asarray(2.0 * a * slope - a * a * curvature)

    @property
    def levels(self) -> FloatArray:
        """Different commands in the recordings, smallest first."""
        return self._numbered[0]

    @cached_property
    def _numbered(self) -> tuple[FloatArray, IntArray]:
        """Different commands, smallest first, and each row's number among them."""
        values, numbers = np.unique(self.commands, return_inverse=True)
        return values, numbers

    @cached_property
    def _few_levels(self) -> tuple[FloatArray, FloatArray] | None:
        """Slope and curvature of chi2 over the levels of a command that takes few values; nothing of one with many."""
        values, numbers = self._numbered
        if values.size > FEW_LEVELS:
            return None
        moved = self._moved((numbers == np.arange(values.size)[:, None]).astype(np.float64))
        return moved @ self.base.e, moved @ self.base.without_numbers(moved.T)

    def _moved(self, commands: FloatArray) -> FloatArray:
        """Return how added (K, N) commands take from the whitened residual, freed of what start states explain."""
        result = np.zeros_like(commands)
        size = next_fast_len(2 * self._answer.size, real=True)
        answer = rfft(self._answer, size)
        for (a, b), Q in zip(self.base.windows, self.base.states_explain, strict=True):
            moved = irfft(rfft(commands[:, a:b], size) * answer, size)[:, : b - a]
            result[:, a:b] = moved - (moved @ Q) @ Q.T  # all trials at once: a window's product, not a loop over rows
        return result


def search_starts(name: str, base: Fit, data: Data, pool: Executor) -> list[Effect]:
    """Return the starting points that an effect's direct search finds on top of a base; none where it has no search."""
    kind = kind_of(name)
    if kind.search is None:
        return []
    return [effect_with(name, values) for values in kind.search(FitScan(name=name, base=base, data=data, pool=pool))]
