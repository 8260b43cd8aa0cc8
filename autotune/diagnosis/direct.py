"""Starting points by direct search: when a step came, at which frequency a force swings, a converter's lattice."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from scipy.signal import fftconvolve, lfilter

from autotune.arrays import FloatArray
from autotune.diagnosis.data import Data
from autotune.diagnosis.fitting import RUNAWAY, Fit
from autotune.diagnosis.parameters import effect_with
from autotune.diagnosis.search import Promise, direction, promise
from autotune.models import Effect
from autotune.recording import Recording

#: Steps in which a frequency is searched, in units of one over the longest recording's duration.
RESOLVED = 0.1
#: Bands of stiction that are tried: the smallest and the largest as a share of the command's size, count.
BANDS_TRIED = (0.002, 0.6, 75)
#: Candidate times of a step per recording.
STEP_TIMES = 16
#: Steps of a converter that are tried, as shares of the standard deviation of u; how closely, as a share of a line's
#: width over u; lines that are looked at, and followed.
STEPS_TRIED, LINE_SHARE, LINES_TRIED, LINES_KEPT = (0.02, 3.0), 0.3, 24, 2


def step_load_starts(base: Fit, data: Data, pool: Executor) -> list[Effect]:
    """Return the most promising step load: its time is searched on a grid, then around the best.

    It comes in one of the recordings, or in all at the same time (number -1), as a test that is repeated brings it.

    Parameters
    ----------
    base : Fit
        What the load is added to.
    data : Data
        Recordings.
    pool : Executor
        Where simulations run.

    Returns
    -------
    list of Effect
        At most one ``environment.step_load``.
    """
    size = 0.02 * max(float(np.nanmax(np.abs(s[:, 3]))) for s in base.signals) or 1.0

    def tried(times: list[tuple[int, float]]) -> Promise:
        effects = [effect_with("environment.step_load", (size, t, 1e18, i)) for i, t in times]
        return max(pool.map(lambda e: promise(base, e, data), effects), key=lambda p: p.decrease)

    grid, step = [], 0.0
    for i, r in enumerate(data.recordings):
        step = r.duration_s / (STEP_TIMES + 1)
        grid += [(i, step * (k + 1)) for k in range(STEP_TIMES)]
    if len(data.recordings) > 1:
        grid += [(-1, step * (k + 1)) for k in range(STEP_TIMES)]
    best = tried(grid)
    for _ in range(3):
        at, number = best.effect.parameters["time"].value, int(best.effect.parameters["recording"].value)
        step /= 3.0
        closer = tried([(number, at - 2 * step), (number, at - step), (number, at + step), (number, at + 2 * step)])
        if closer.decrease > best.decrease:
            best = closer
    return [best.effect] if best.decrease > 0.0 else []


def periodogram(base: Fit, data: Data) -> tuple[FloatArray, FloatArray]:
    """Return frequencies [Hz] and the decrease of chi2 that a sinusoid common to all recordings brings at each.

    Phases count from each recording's start, so that one load swings through all of them coherently. Rows are taken
    as equidistant, which is good enough for a starting value.
    """
    dt = data.recordings[0].sample_time_s
    size = 4 * int(2 ** np.ceil(np.log2(max(len(r) for r in data.recordings))))
    total = np.zeros(size // 2 + 1, dtype=np.complex128)
    for e in base.whitened:
        total += np.fft.rfft(e, size)
    rows = sum(e.size for e in base.whitened)
    return np.asarray(np.fft.rfftfreq(size, dt)), np.asarray(2.0 * np.abs(total) ** 2 / rows)


def periodic_load_starts(base: Fit, data: Data, lag_s: float, count: int = 3) -> list[Effect]:
    """Return starts for a periodic load at the strongest lines of the residual.

    Parameters
    ----------
    base : Fit
        What the load is added to.
    data : Data
        Recordings.
    lag_s : float
        The plant's slowest lag [s]: far above its corner no load shows.
    count : int
        Number of lines.
    """
    duration = max(r.duration_s for r in data.recordings)
    dt = data.recordings[0].sample_time_s
    frequencies, power = periodogram(base, data)
    use = (frequencies >= 1.0 / duration) & (frequencies <= min(0.2 / dt, 10.0 / lag_s))
    frequencies, power = frequencies[use], power[use]
    if frequencies.size < 3:
        return []
    inner = np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])) + 1
    lines = inner[np.argsort(-power[inner])][:count]
    size = 0.02 * max(float(np.nanmax(np.abs(s[:, 3]))) for s in base.signals) or 1.0

    def sinusoid(frequency: float) -> tuple[float, Effect]:
        """Return the decrease of chi2 that both parts together promise at a frequency, and the load."""
        parts = ((size, 0.0, frequency), (0.0, size, frequency))
        try:
            D = np.column_stack([direction(base, effect_with("environment.periodic_load", p), data) for p in parts])
        except RUNAWAY:
            return 0.0, effect_with("environment.periodic_load", parts[0])
        a = np.linalg.lstsq(D.T @ base.without_numbers(D), -D.T @ base.e)[0]
        load = (float(size * a[0]), float(size * a[1]), frequency)
        return float(-base.e @ D @ a), effect_with("environment.periodic_load", load)

    # the load's own frequency lies beside the residual's line: within a tenth of what the recordings resolve
    near = [[float(frequencies[line]) + k * RESOLVED / duration for k in range(-2, 3)] for line in lines]
    return [max((sinusoid(f) for f in group), key=lambda found: found[0])[1] for group in near]


def command_influence(base: Fit, data: Data) -> tuple[FloatArray, FloatArray]:
    """Return the commands inside the windows, and how the misfit would fall with more of each: -0.5 d chi2/du.

    The chain alone answers, its effects left aside, and rows are taken as equidistant: good enough to start from.
    """
    longest = max(int(np.max(b - a)) for a, b in zip(data.starts, data.stops, strict=True))
    pulse = np.zeros(longest + 1)
    pulse[1] = 1.0  # what stands in the first row has stood before it
    dt, sim = data.recordings[0].sample_time_s, base.sim
    still = replace(sim, on=np.zeros_like(sim.on), forced=False, falling=sim.chain, linear_hold=False)
    struck = Recording(t=dt * np.arange(longest + 1, dtype=np.float64), u=sim.u_offset + pulse, y=0.0 * pulse)
    answer = still.run(struck, np.zeros((1, sim.chain.order)))[1:, 0]
    answer = lfilter([1.0, *(-a for a in data.noise.ar)], [1.0], answer - sim.y_offset) / data.noise.sd
    commands, influence = [], []
    for r, e, starts, stops in zip(data.recordings, base.whitened, data.starts, data.stops, strict=True):
        for a, b in zip(starts, stops, strict=True):
            commands.append(r.u[a:b])
            influence.append(fftconvolve(e[a:b], answer[: b - a][::-1])[b - a - 1 :])
    return np.concatenate(commands), np.concatenate(influence)


def quantisation_starts(base: Fit, data: Data, pool: Executor) -> list[Effect]:
    """Return the most promising lattice of the actuator's converter: lines of the residual over u, then around them.

    A converter adds a saw-tooth of u, whose period is its step: its fundamental is a line of the influence's
    periodogram over the command, as a periodic load's is one over time.

    Parameters
    ----------
    base : Fit
        What the converter is added to.
    data : Data
        Recordings.
    pool : Executor
        Where simulations run.

    Returns
    -------
    list of Effect
        At most one ``actuator.quantisation``. Its origin is the point of the lattice nearest to the middle of u, so
        that a small error of the step does not move the lattice away.
    """
    u, influence = command_influence(base, data)
    middle, spread, span = float(np.median(u)), float(np.std(u)), float(np.ptp(u))
    if spread == 0.0:
        return []
    smallest, largest = STEPS_TRIED
    per_step = np.arange(1.0 / (largest * spread), 1.0 / (smallest * spread), LINE_SHARE / span)
    values, where = np.unique(u - middle, return_inverse=True)
    weights = np.bincount(where, influence)
    lines = np.array([weights @ np.exp(2j * np.pi * f * values) for f in per_step])
    power = np.abs(lines)
    inner = np.flatnonzero((power >= np.append(power[1:], 0.0)) & (power >= np.append(0.0, power[:-1])))
    best_lines = inner[np.argsort(-power[inner])][:LINES_TRIED]

    def tried(lattices: list[tuple[float, float]]) -> list[Promise]:
        effects = [effect_with("actuator.quantisation", (step, middle + step * phase)) for step, phase in lattices]
        return sorted(pool.map(lambda e: promise(base, e, data), effects), key=lambda p: -p.decrease)

    # round(x) - x = -sin(2 pi x)/pi + ...: where the line's phase puts the fall through zero there is a level
    turns = (np.angle(lines) / (2.0 * np.pi) + 0.25 + 0.5) % 1.0 - 0.5
    best = tried([(1.0 / per_step[i], turns[i]) for i in best_lines])[:LINES_KEPT]
    width, turn = LINE_SHARE, 0.1
    for _ in range(4):
        near = []
        for p in best:
            q = p.effect.parameters
            step, phase = q["step"].value, (q["origin"].value - middle) / q["step"].value
            beside = [step / (1.0 + i * width * step / span) for i in (-1, 0, 1)]
            near += [(h, phase + turn * k) for i, h in enumerate(beside) for k in (-1, 0, 1) if i != 1 or k]
        best = sorted((*best, *tried(near)), key=lambda p: -p.decrease)[:LINES_KEPT]
        width, turn = 0.5 * width, 0.5 * turn
    return [best[0].effect] if best and best[0].decrease > 0.0 else []


def stiction_starts(base: Fit, data: Data, pool: Executor, w: float) -> list[Effect]:
    """Return the most promising bands of a valve that sticks: every band moves other jumps, so peaks are narrow.

    Parameters
    ----------
    base : Fit
        What stiction is added to.
    data : Data
        Recordings.
    pool : Executor
        Where simulations run.
    w : float
        Size of the command's deviations.

    Returns
    -------
    list of Effect
        At most two ``actuator.stiction``.
    """

    def tried(bands: FloatArray) -> list[Promise]:
        effects = [effect_with("actuator.stiction", (float(band),)) for band in bands]
        return sorted(pool.map(lambda e: promise(base, e, data), effects), key=lambda p: -p.decrease)

    low, high, count = BANDS_TRIED
    best = tried(w * np.geomspace(low, high, count))[:3]
    ratio = (high / low) ** (1.0 / (count - 1))
    for _ in range(2):
        around = np.concatenate(
            [p.effect.parameters["band"].value * ratio ** np.array([-0.6, -0.3, 0.3, 0.6]) for p in best]
        )
        best = sorted((*best, *tried(around)), key=lambda p: -p.decrease)[:2]
        ratio **= 0.3
    return [p.effect for p in best if p.decrease > 0.0]
