"""Cheap looks at recordings and residuals, each with one sentence of what it says: pictures before any hypothesis.

Every screen is a pure function of what was recorded and of a fit; it blames nothing, it shows where to look.

One record and one function per screen: the file is as long as there are screens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import welch

from autotune.arrays import FloatArray
from autotune.controller import Controller
from autotune.diagnosis.evidence.law import shown_law, stated_law
from autotune.diagnosis.evidence.readings import converter_step, frozen_rows
from autotune.diagnosis.evidence.residual import filled
from autotune.diagnosis.fitting.data import Data
from autotune.diagnosis.fitting.fit import Fit
from autotune.recording import Recording

#: Step between time stamps that is off, as a share of the sample time.
OFF_STAMP = 0.01
#: Correlation of u with itself one period later from which on a recording counts as periodic, and periods needed.
PERIODIC, LEAST_PERIODS = 0.9, 3
#: Harmonics looked at.
HARMONICS = 10
#: Bins of a curve of means; standard errors beyond which a mean is more than chance.
BINS, CLEAR = 24, 3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class StampScreen:
    """Steps between time stamps in sample times, (N-1,) per recording."""

    steps: tuple[FloatArray, ...]
    sentence: str


@dataclass(frozen=True, kw_only=True, eq=False)
class ValueScreen:
    """Readings of all recordings, (N,), that are numbers; ``step`` is the converter's, 0 where none shows."""

    values: FloatArray
    step: float
    sentence: str


@dataclass(frozen=True, kw_only=True, eq=False)
class LawScreen:
    """Recorded command and the one recomputed by the stated law, (N,) each, of recording ``number``."""

    number: int
    t: FloatArray
    recorded: FloatArray
    recomputed: FloatArray
    sentence: str


@dataclass(frozen=True, kw_only=True, eq=False)
class PeriodScreen:
    """Residual folded over the period of u.

    Attributes
    ----------
    number : int
        Recording.
    period_s : float
        Period [s].
    phase, mean, spread : (P,) array
        Time within the period [s], mean residual there, and its standard error from period to period.
    harmonics : (H,) array
        Amplitude of the mean residual at harmonics 1 to H.
    floor : float
        Amplitude that noise leaves there.
    sentence, harmonic_sentence : str
        What folding and harmonics say.
    """

    number: int
    period_s: float
    phase: FloatArray
    mean: FloatArray
    spread: FloatArray
    harmonics: FloatArray
    floor: float
    sentence: str
    harmonic_sentence: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Means:
    """Means of the residual in units of the noise, with standard errors, over bins of a signal, (B,) each."""

    signal: str
    x: FloatArray
    mean: FloatArray
    error: FloatArray
    explained: float


@dataclass(frozen=True, kw_only=True, eq=False)
class DirectionScreen:
    """Mean residual over the speed of the simulated reading, where it rises and where it falls."""

    rising: Means
    falling: Means
    sentence: str


@dataclass(frozen=True, kw_only=True, eq=False)
class WindowScreen:
    """What one more step of fitting would make of a free number in every window alone.

    Attributes
    ----------
    name, unit : str
        The number that varies most beyond its uncertainty, and the unit of its change.
    t, change, sd : (W,) array
        Middle of each window, one recording after the other [s]; change from the fitted value and its 1-sigma.
    against : str
        Signal that the change goes with most.
    x : (W,) array
        Its mean in each window.
    sentence : str
        What they say.
    """

    name: str
    unit: str
    t: FloatArray
    change: FloatArray
    sd: FloatArray
    against: str
    x: FloatArray
    sentence: str


def stamp_screen(recordings: Sequence[Recording]) -> StampScreen:
    """Look at the steps between time stamps."""
    steps = tuple(np.diff(r.t) / r.sample_time_s for r in recordings)
    every = np.concatenate(steps)
    off = int(np.sum(np.abs(every - 1.0) > OFF_STAMP))
    worst = float(every[np.argmax(np.abs(every - 1.0))])
    says = f"{off} of {every.size} steps are more than 1 % off the sample time, the worst is {worst:.3g} of it."
    return StampScreen(steps=steps, sentence=says if off else "Every time stamp is on its grid to within 1 %.")


def value_screen(recordings: Sequence[Recording]) -> ValueScreen:
    """Look at the values that the reading takes: converter steps, end stops, repeated readings."""
    y = np.concatenate([r.y for r in recordings])
    y = y[np.isfinite(y)]
    step = converter_step(y)
    frozen = sum(int(frozen_rows(r.y).sum()) for r in recordings)
    ends = max(int(np.sum(y == y.min())), int(np.sum(y == y.max())))
    parts = [f"{np.unique(y).size} different values in {y.size} readings"]
    parts.append(f"all multiples of {step:.4g}" if step else "on no common step")
    parts.append(f"{frozen} repeat the reading before in runs of three or more")
    parts.append(f"an extreme value is taken {ends} times" if ends > 1 else "no extreme value is taken twice")
    return ValueScreen(values=y, step=step, sentence=", ".join(parts) + ".")


def law_screen(recordings: Sequence[Recording], controller: Controller | None = None) -> LawScreen | None:
    """Recompute u from r and y by the stated law; nothing where no recording has a set-point and a stated law."""
    for number, r in enumerate(recordings):
        stated = stated_law(r.metadata, controller)
        shown = None if stated is None else shown_law(r, stated)
        if shown is None:
            continue
        share = float(np.std(r.u - shown.recomputed) / float(np.std(r.u)))
        gain = shown.factors["gain_factor"]
        says = (
            f"The stated law leaves {100 * share:.2g} % of the spread of u (what was added to its output counts); "
            f"the recording shows {gain.value:.3g} ± {1.96 * gain.sd:.2g} of the stated gain."
        )
        return LawScreen(number=number, t=r.t, recorded=r.u, recomputed=shown.recomputed, sentence=says)
    return None


def period_of(u: FloatArray) -> int:
    """Return the period of a command in rows, 0 where it has none that is repeated often enough."""
    w = u - np.mean(u)
    if not np.any(w):
        return 0
    size = 2 ** int(np.ceil(np.log2(2 * w.size)))
    spectrum = np.abs(np.fft.rfft(w, size)) ** 2
    lags = w.size // LEAST_PERIODS
    correlation = np.fft.irfft(spectrum, size)[: lags + 1] / (w.size - np.arange(lags + 1))
    correlation /= correlation[0]
    below = np.flatnonzero(correlation < 0.5)
    if not below.size or below[0] >= lags:
        return 0
    later = correlation[below[0] :]
    if later.max() < PERIODIC:
        return 0
    # multiples of the period correlate as well: the first peak counts
    first = int(np.argmax(later > later.max() - 0.02))
    peak = int(below[0] + first + np.argmax(later[first : first + max(2, below[0])]))
    return peak if peak < lags else 0


def period_screen(result: Fit, data: Data) -> PeriodScreen | None:
    """Fold the residual over the period of u; nothing where no recording's u is periodic."""
    for number, (r, e) in enumerate(zip(data.recordings, result.residuals, strict=True)):
        P = period_of(r.u)
        if P < 2 * HARMONICS // 3:
            continue
        count = len(r) // P
        folded = e[len(r) - count * P :].reshape(count, P)
        mean, spread = folded.mean(axis=0), folded.std(axis=0, ddof=1) / np.sqrt(count)
        chance = float(np.mean(spread**2))
        total = float(np.mean(folded**2))
        share = float(np.clip((np.mean(mean**2) - chance) / max(total, 1e-300), 0.0, 1.0))
        amplitudes = 2.0 * np.abs(np.fft.rfft(mean))[1 : min(HARMONICS, P // 2) + 1] / P
        floor = 2.0 * np.sqrt(chance / P)
        power = np.maximum(amplitudes**2 - floor**2, 0.0)
        even = float(power[1::2].sum() / power[1:].sum()) if power[1:].sum() > 0.0 else 0.0
        says = (
            f"{100 * share:.0f} % of the residual's power repeats over {count} periods of {P * r.sample_time_s:.4g} s: "
            "that part is the model's, the rest is noise or load."
        )
        kind = "what is missing is alike in both directions" if even < 0.3 else "what is missing prefers a direction"
        about = f"Of the power above the first harmonic {100 * even:.0f} % is at even ones: {kind}."
        clear = bool(np.any(amplitudes[1:] > 3.0 * floor))
        return PeriodScreen(
            number=number, period_s=P * r.sample_time_s, phase=np.asarray(r.sample_time_s * np.arange(P)), mean=mean,
            spread=spread, harmonics=amplitudes, floor=floor, sentence=says,
            harmonic_sentence=about if clear else "No harmonic of the residual stands above the noise.",
        )  # fmt: skip
    return None


def means_over(signal: str, x: FloatArray, e: FloatArray, per_row: float = 1.0, bins: int = BINS) -> Means:
    """Return the residual's means over bins of equal numbers of rows.

    Parameters
    ----------
    signal : str
        Name of x.
    x, e : (N,) array
        Signal, and residual in units of the noise.
    per_row : float
        Independent rows per row, 1 for white noise.
    bins : int
        Number of bins, fewer where there are few rows.
    """
    parts = np.array_split(np.argsort(x, kind="stable"), max(2, min(bins, x.size // 20)))
    mean = np.array([e[p].mean() for p in parts])
    error = np.array([e[p].std() / np.sqrt(max(per_row * p.size, 1.0)) for p in parts])
    between = sum(p.size * m**2 for p, m in zip(parts, mean, strict=True))
    return Means(
        signal=signal, x=np.array([x[p].mean() for p in parts]), mean=mean, error=error,
        explained=float(between / max(float(e @ e), 1e-300)),
    )  # fmt: skip


def independent_share(result: Fit) -> float:
    """Return independent rows per row of a residual, from its correlation from one row to the next."""
    e = np.concatenate(result.residuals)
    rho = float(np.clip(e[1:] @ e[:-1] / max(float(e @ e), 1e-300), 0.0, 0.99))
    return (1.0 - rho) / (1.0 + rho)


def signals_of(result: Fit, data: Data) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return every signal that the residual can be drawn over, with the rows that count, and the residual there."""
    sd = data.noise.total_sd
    good = np.concatenate(data.good) & np.isfinite(np.concatenate([s[:, 0] for s in result.signals]))
    e = np.concatenate(result.residuals)[good] / sd
    out = np.concatenate(result.signals)[good]
    u = np.concatenate([r.u for r in data.recordings])[good]
    clock = np.concatenate([r.t - r.t[0] for r in data.recordings])[good]
    mechanical = result.sim.chain.is_mechanical
    named = {"command u": u, "reading": out[:, 0], "plant input": out[:, 3], "time in the recording [s]": clock}
    named |= {"speed": out[:, 1], "position": out[:, 2]} if mechanical else {"level": out[:, 2]}
    if all("u_applied" in r.extra for r in data.recordings):
        named["u_applied"] = np.concatenate([r["u_applied"] for r in data.recordings])[good]
    return {name: (x, e) for name, x in named.items() if np.all(np.isfinite(x)) and np.ptp(x) > 0.0}


def direction_screen(result: Fit, data: Data) -> DirectionScreen | None:
    """Compare the residual where the simulated reading rises with where it falls."""
    sd, per_row = data.noise.total_sd, independent_share(result)
    good = np.concatenate(data.good) & np.isfinite(np.concatenate([s[:, 0] for s in result.signals]))
    rates = [np.gradient(filled(s)[:, 0], r.t) for s, r in zip(result.signals, data.recordings, strict=True)]
    rate = np.concatenate(rates)
    e = np.concatenate(result.residuals) / sd
    up, down = good & (rate > 0.0), good & (rate < 0.0)
    gaps = []
    for a, b in result.windows:
        if min(up[a:b].sum(), down[a:b].sum()) >= 5:
            gaps.append(e[a:b][up[a:b]].mean() - e[a:b][down[a:b]].mean())
    if len(gaps) < 4:
        return None
    rising = means_over("rate of the reading, rising", rate[up], e[up], per_row, BINS // 2)
    falling = means_over("rate of the reading, falling", -rate[down], e[down], per_row, BINS // 2)
    gap, error = float(np.mean(gaps)), float(np.std(gaps, ddof=1) / np.sqrt(len(gaps)))
    verdict = "more than chance" if abs(gap) > CLEAR * error else "within chance"
    says = f"Rising less falling, the mean residual differs by {gap:.2g} ± {1.96 * error:.2g} noise sd: {verdict}."
    return DirectionScreen(rising=rising, falling=falling, sentence=says)


def window_screen(result: Fit, data: Data) -> WindowScreen | None:
    """Let every window alone move each free number of the chain, and report the one that varies most."""
    J, e = result.jacobian[0].copy(), result.e.copy()
    p = result.parametrisation
    changes, sds = [], []
    for (a, b), Q in zip(result.windows, result.states_explain, strict=True):
        Jw, ew = J[a:b] - Q @ (Q.T @ J[a:b]), e[a:b] - Q @ (Q.T @ e[a:b])
        inverse = np.linalg.pinv(Jw.T @ Jw + np.diag(1.0 / p.spreads**2), hermitian=True)
        changes.append(-inverse @ (Jw.T @ ew))
        sds.append(np.sqrt(np.maximum(np.diag(inverse), 0.0)))
    if len(changes) < 4:
        return None
    change, sd = np.array(changes), np.array(sds)
    told = np.where(np.isfinite(p.spreads), np.median(sd, axis=0) < 0.7 * p.spreads, np.median(sd, axis=0) > 0.0)
    excess = np.where(told, np.median((change / np.maximum(sd, 1e-300)) ** 2, axis=0) / 0.455, 0.0)
    i = int(np.argmax(excess))
    free = p.free[i]
    factor, unit = (
        (100.0, "%") if free.positive else (free.size, p.model.input.unit if free.kind == "u_offset" else "s")
    )
    t, middles = 0.0, []
    for rec, starts, stops in zip(data.recordings, data.starts, data.stops, strict=True):
        middles += [t + 0.5 * (rec.t[a] + rec.t[b - 1]) - rec.t[0] for a, b in zip(starts, stops, strict=True)]
        t += rec.duration_s
    against, x, r = _goes_with(change[:, i], result, data, np.array(middles))
    name = {"gain": "the gain", "u_offset": "the input offset", "delay": "the dead time"}.get(free.kind, free.name)
    wide = f"from {factor * change[:, i].min():+.2g} to {factor * change[:, i].max():+.2g} {unit}"
    if excess[i] > 3.0:
        says = f"From window to window {name} varies most, {wide}, and goes with {against} (correlation {r:.2f})."
    else:
        says = f"No number varies from window to window beyond its uncertainty; the nearest to it is {name}."
    return WindowScreen(
        name=name, unit=unit, t=np.array(middles), change=factor * change[:, i], sd=factor * sd[:, i], against=against,
        x=x, sentence=says,
    )  # fmt: skip


def _goes_with(change: FloatArray, result: Fit, data: Data, middles: FloatArray) -> tuple[str, FloatArray, float]:
    """Return the signal whose mean or size in the windows a change goes with most."""
    out = np.concatenate(result.signals)
    u = np.concatenate([r.u for r in data.recordings])
    named: dict[str, FloatArray] = {"time": middles}
    for name, x in (("the reading", out[:, 0]), ("the command", u)):
        named[f"the mean of {name}"] = np.array([x[a:b].mean() for a, b in result.windows])
        named[f"the spread of {name}"] = np.array([x[a:b].std() for a, b in result.windows])
    usable = {name: x for name, x in named.items() if np.ptp(x) > 0.0}
    correlations = {name: float(np.corrcoef(x, change)[0, 1]) for name, x in usable.items()}
    best = max(correlations, key=lambda name: abs(correlations[name]))
    return best, usable[best], correlations[best]


@dataclass(frozen=True, kw_only=True, eq=False)
class SpectrumScreen:
    """Power spectral density of the retuned and the extended model's residuals and of the noise, (F,) each."""

    frequency_hz: FloatArray
    retuned: FloatArray
    extended: FloatArray
    noise: FloatArray
    sentence: str


def spectrum_screen(retuned: Fit, extended: Fit, data: Data) -> SpectrumScreen:
    """Compare the residuals' spectra with that of the noise model, over the longest recording (Welch)."""
    number = int(np.argmax([len(r) for r in data.recordings]))
    dt = data.recordings[number].sample_time_s
    length = min(1024, max(64, len(data.recordings[number]) // 6))
    f, before = welch(retuned.residuals[number], 1.0 / dt, nperseg=length)
    _, after = welch(extended.residuals[number], 1.0 / dt, nperseg=length)
    lags = np.exp(-2j * np.pi * f[:, None] * dt * np.arange(1, len(data.noise.ar) + 1))
    noise = 2.0 * dt * data.noise.sd**2 / np.abs(1.0 - lags @ np.array(data.noise.ar)) ** 2
    f, before, after, noise = f[1:-1], before[1:-1], after[1:-1], noise[1:-1]
    ratio = before / noise
    top = int(np.argmax(ratio))
    low, high = f[ratio > 4.0][[0, -1]] if np.any(ratio > 4.0) else (f[top], f[top])
    says = (
        f"What retuning leaves stands above the noise between {low:.3g} and {high:.3g} Hz, most at {f[top]:.3g} Hz "
        f"({ratio[top]:.3g} times its power)."
    )
    if ratio[top] < 4.0:
        says = "At no frequency does what retuning leaves stand clearly above the noise."
    return SpectrumScreen(frequency_hz=f, retuned=before, extended=after, noise=noise, sentence=says)
