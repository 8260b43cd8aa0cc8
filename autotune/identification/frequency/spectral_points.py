"""Frequency points from the spectra of a recording without a relay: local polynomials, or lines that repeat."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeAlias

import numpy as np

from autotune.arrays import BoolArray, ComplexArray, FloatArray, is_constant
from autotune.errors import IdentificationError
from autotune.identification.frequency.excitation import repeat_length
from autotune.identification.frequency.limit_cycle_points import LimitCycle
from autotune.identification.frequency.line_points import line_points
from autotune.identification.frequency.local_polynomial import LocalEstimate, local_estimate
from autotune.identification.frequency.reference_model import ReferenceModel, fit_reference, simulate_reference
from autotune.identification.frequency.spectra import Spectra, clean_measurement, common_rounding, record_spectra
from autotune.identification.parametric import PlantFit
from autotune.points import FrequencyPoint
from autotune.recording import Recording

Excitation: TypeAlias = Literal["relay", "repeated command", "sines", "random or steps", "closed loop by way of r"]

#: Frequencies per decade: the finer grid where it gives enough points, wider windows where the data are poorer.
_PER_DECADE = (10, 5, 3, 2)
_ENOUGH_POINTS = 4
_LEAST_LINES = 13
_HIGHEST_PART = 0.1  # of the sampling frequency: the images of the hold and the noise of the stamps stay below
_ROUNDS = 6


@dataclass(frozen=True, kw_only=True)
class FrequencyEstimate:
    """What one recording says about the plant's frequency response.

    Attributes
    ----------
    points : tuple of FrequencyPoint
        Ascending in frequency.
    excitation : str
        What kind of experiment the recording was found to hold.
    cycles : tuple of LimitCycle
        The limit cycles, where it was a relay's.
    notes : tuple of str
        What was left out or corrected, and why.
    fit : PlantFit or None
        The plant that gave the points, where all rows of a sweep did together.
    """

    points: tuple[FrequencyPoint, ...]
    excitation: Excitation
    cycles: tuple[LimitCycle, ...] = ()
    notes: tuple[str, ...] = ()
    fit: PlantFit | None = None


def points_of_spectra(recording: Recording, largest_relative_sd: float) -> FrequencyEstimate:
    """Estimate frequency points from the spectra of a recording.

    Parameters
    ----------
    recording : Recording
        u and y, perhaps r, evenly sampled.
    largest_relative_sd : float
        Points with a larger standard deviation over their gain are left out.

    Raises
    ------
    IdentificationError
        Too few rows, or nothing that tells of the plant.
    """
    if len(recording) < 4 * _LEAST_LINES:
        raise IdentificationError(
            f"{len(recording)} rows are too few", where=recording.name, remedy="record for longer"
        )
    y, bad = clean_measurement(recording.t, recording.y, recording.name)
    t, u = recording.t, recording.u
    r = _moving_setpoint(recording)
    repeat = repeat_length(recording) if r is None else None
    if r is None and repeat is None:
        of_lines = line_points(t, u, y, held=recording.metadata.get("hold") != "linear")
        sure = tuple(point for point in of_lines if _relative_sd(point) <= largest_relative_sd)
        if sure:
            return FrequencyEstimate(points=sure, excitation="sines")
    if repeat is not None:
        rows = repeat * (t.size // repeat)
        t, u, y = t[-rows:], u[-rows:], y[-rows:]
    notes = [f"{bad} wild or missing samples of y were interpolated"] if bad else []
    transform = partial(
        record_spectra, t, u, r=r, common=common_rounding(recording.y),
        highest_rad_s=_HIGHEST_PART * 2.0 * math.pi / float(np.mean(np.diff(t))),
    )  # fmt: skip
    kind: Excitation = "random or steps" if repeat is None else "repeated command"
    kind = "closed loop by way of r" if r is not None else kind
    source = {"random or steps": "local polynomial", "repeated command": "spectral"}.get(kind, "closed loop")
    kept: tuple[FrequencyPoint, ...] = ()
    tried = 0
    for per_decade in _PER_DECADE:
        estimates, reference = _estimate_corrected(transform, t, u, y, repeat=repeat, per_decade=per_decade)
        points = [point for one in estimates if (point := _point(one, reference, source)) is not None]
        enough = tuple(point for point in points if _relative_sd(point, reference) <= largest_relative_sd)
        if len(enough) > len(kept):
            kept, tried = enough, len(estimates)
        if repeat is not None or len(kept) >= _ENOUGH_POINTS:
            break
    if len(kept) < tried:
        notes.append(
            f"{tried - len(kept)} of {tried} frequencies left out: the standard deviation of the response is above"
            f" {100 * largest_relative_sd:.0f} % of the plant's gain"
        )
    if not kept:
        raise IdentificationError(
            "no frequency stands above the noise", where=recording.name, remedy="excite more strongly or for longer"
        )
    return FrequencyEstimate(points=kept, excitation=kind, notes=tuple(notes))


def _moving_setpoint(recording: Recording) -> FloatArray | None:
    """Return r where it was recorded, moves, and moves u: more than chance would correlate them."""
    r = recording.extra.get("r")
    if r is None or not np.all(np.isfinite(r)) or is_constant(r):
        return None
    n = r.size
    a, b = np.fft.rfft(r - r.mean(), 2 * n), np.fft.rfft(recording.u - recording.u.mean(), 2 * n)
    cross = np.fft.irfft(a.conj() * b, 2 * n)[: n // 4]
    limit = 5.0 * math.sqrt(n) * float(np.std(r) * np.std(recording.u))
    return r if float(np.max(np.abs(cross))) > limit else None


def _estimate_corrected(
    transform: Callable[..., Spectra],
    t: FloatArray,
    u: FloatArray,
    y: FloatArray,
    *,
    repeat: int | None,
    per_decade: int,
) -> tuple[list[LocalEstimate], ReferenceModel | None]:
    """Estimate on y, then again on what a rough model leaves of it, if one describes the estimates at all."""
    centred = u - u.mean()
    reference: ReferenceModel | None = None
    spectra = transform(e=y)
    estimates = _estimates(spectra, t.size, repeat, per_decade)
    for _ in range(_ROUNDS):
        points = [point for one in estimates if (point := _point(one, reference, ""))]
        if not points:
            break
        best = _scatter(estimates) * (1.1 if reference is None else 1.05)
        better = None
        for integrating in (False, True):
            trial = _reference(points, spectra, integrating)
            left = y - simulate_reference(t, centred, trial)
            trial_spectra = transform(e=left)
            trial_estimates = _estimates(trial_spectra, t.size, repeat, per_decade)
            if _scatter(trial_estimates) < best:
                best, better = _scatter(trial_estimates), (trial, trial_spectra, trial_estimates)
        if better is None:  # the rough model adds leakage of its own
            break
        reference, spectra, estimates = better
    return estimates, reference


def _reference(points: Sequence[FrequencyPoint], spectra: Spectra, integrating: bool) -> ReferenceModel:
    omega = np.array([point.omega_rad_s for point in points])
    G = np.array([point.response for point in points])
    sd = np.array([_relative_sd(point) for point in points]) * np.abs(G)
    strength = np.interp(omega, spectra.omega_rad_s, _smooth(spectra.weight * np.abs(spectra.U)))
    return fit_reference(omega, G, sd, strength, integrating=integrating)


def _scatter(estimates: Sequence[LocalEstimate]) -> float:
    """Return the geometric mean of the estimates' standard deviations."""
    variances = [max(float(one.covariance[0, 0].real), 1e-300) for one in estimates]
    return math.exp(0.5 * float(np.mean(np.log(variances)))) if variances else math.inf


def _smooth(values: FloatArray) -> FloatArray:
    kernel = np.ones(min(_LEAST_LINES, values.size))
    return np.asarray(np.sqrt(np.convolve(values**2, kernel, "same") / kernel.size))


def _estimates(spectra: Spectra, rows: int, repeat: int | None, per_decade: int) -> list[LocalEstimate]:
    if repeat is not None:
        return _on_excited_lines(spectra, rows // repeat)
    return _on_grid(spectra, per_decade)


def _on_excited_lines(spectra: Spectra, repeats: int) -> list[LocalEstimate]:
    """Estimate at every line of a repeated command that carries it; the lines between give leakage and noise."""
    size: FloatArray = np.abs(spectra.U)
    index = np.arange(size.size) + 1
    excited = (index % repeats == 0) & (size > 0.02 * size.max())
    found = []
    half = min(max(_LEAST_LINES // 2, 2 * repeats), (size.size - 1) // 2)
    for line in np.flatnonzero(excited):
        low = int(np.clip(line - half, 0, size.size - 2 * half - 1))
        window = slice(low, low + 2 * half + 1)
        one = local_estimate(
            spectra.omega_rad_s[window],
            (spectra.weight * spectra.U)[window],
            (spectra.weight * spectra.E)[window, None],
            float(spectra.omega_rad_s[line]),
            excited=_near(excited, int(line), window),
            common=_weighted_common(spectra, window),
        )
        if one is not None:
            found.append(one)
    return found


def _weighted_common(spectra: Spectra, window: slice) -> float:
    return spectra.common * float(np.mean(spectra.weight[window] ** 2))


def _near(excited: BoolArray, line: int, window: slice) -> BoolArray:
    mask = excited.copy()
    mask[line] = True
    return np.asarray(mask[window])


def _on_grid(spectra: Spectra, per_decade: int) -> list[LocalEstimate]:
    """Estimate on a grid that is the same for every recording, from windows that do not overlap."""
    omega = spectra.omega_rad_s
    X = spectra.weight * (spectra.U if spectra.R is None else spectra.R)
    outputs = (spectra.E,) if spectra.R is None else (spectra.E, spectra.U)
    Z: ComplexArray = np.stack([spectra.weight * output for output in outputs], axis=1)
    first = math.ceil(per_decade * math.log10(omega[0]))
    last = math.floor(per_decade * math.log10(omega[-1]))
    found, free = [], 0
    half_width = 10.0 ** (0.5 / per_decade)
    for centre in 10.0 ** (np.arange(first, last + 1) / per_decade):
        low = int(np.searchsorted(omega, centre / half_width))
        high = int(np.searchsorted(omega, centre * half_width))
        if high - low < _LEAST_LINES:
            middle = int(np.searchsorted(omega, centre))
            low, high = middle - _LEAST_LINES // 2, middle + _LEAST_LINES // 2 + 1
        if low < free or high > omega.size:
            continue
        window = slice(low, high)
        one = local_estimate(
            omega[window], X[window], Z[window], float(centre), common=_weighted_common(spectra, window)
        )
        if one is not None:
            found.append(one)
            free = high
    return found


def _point(estimate: LocalEstimate, reference: ReferenceModel | None, source: str) -> FrequencyPoint | None:
    """Return G with its covariance; in closed loop G = G_yr / G_ur, None where r does not reach u."""
    base = complex(reference.response(np.array([estimate.omega_rad_s]))[0]) if reference is not None else 0.0
    if estimate.gain.size == 1:
        response, variance = complex(estimate.gain[0]), float(estimate.covariance[0, 0].real)
    else:
        e, u = estimate.gain
        if abs(u) < 4.0 * math.sqrt(float(estimate.covariance[1, 1].real)):
            return None
        response = complex(e / u)
        weights: ComplexArray = np.array([1.0, -response]) / u
        variance = float((weights @ estimate.covariance @ weights.conj()).real)
    half = 0.5 * variance * estimate.inflation
    return FrequencyPoint(
        omega_rad_s=estimate.omega_rad_s,
        response=base + response,
        covariance=((half, 0.0), (0.0, half)),
        source=source,
    )


def _relative_sd(point: FrequencyPoint, reference: ReferenceModel | None = None) -> float:
    """Return sd over gain; over the rough model's gain where there is one, so that no lucky estimate is favoured."""
    gain = point.gain
    if reference is not None:
        gain = float(np.abs(reference.response(np.array([point.omega_rad_s])))[0])
    return math.sqrt(0.5 * (point.covariance[0][0] + point.covariance[1][1])) / max(gain, 1e-300)
