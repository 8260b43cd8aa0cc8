"""Plants of low order that pass through measured points: resonant, leading, with inverse response, or unstable.

Each structure is

    H(s) = b exp(-s L) N(s)/D(s),   D = [1 | s | 1 + s T | 1 - s T | pair] [1 | 1 + s T_2 | pair],
    N = [1 | 1 + s a, a of either sign | pair],   pair = 1 + 2 zeta s/omega_0 + s^2/omega_0^2,

strictly proper, with the zero in the left half plane where a pole is unstable. What the points leave possible is the
joint region of their errors: every plant whose weighted squared distance from all of them is below the quantile. It is
sampled, not linearised, because five points seldom determine seven parameters. Structures come by their number of
parameters: those with at most two more than the smallest that has a member.

A pole and a zero that nearly cancel can be put between any points, and a resonance beyond the last of them: neither is
a member. Light damping is taken to lie between half of the lowest and 1.3 times the highest frequency. A second pair of
poles stands for two modes in series of which the points show one: it has a damping of a tenth at least and lies at up
to three times the highest frequency.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from autotune.arrays import BoolArray, FloatArray
from autotune.identification.structure_evidence import (
    FURTHER,
    STRUCTURES,
    Evidence,
    Structure,
    are_admitted,
    bounds,
    evidence_of,
    responses,
)
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint

#: of the joint region of all points that a plant passes through
_PROBABILITY = 0.99
#: structures with so many more parameters than the smallest that fits are members too
_MORE = 2
_WALKERS, _STEPS, _KEPT = 48, 400, 64
_STARTS, _ROUNDS = 12, 60


def _starts(structure: Structure, evidence: Evidence, rng: np.random.Generator) -> tuple[FloatArray, ...]:
    """Return (K, P) starting values all over the bounds, and the bounds."""
    lower, upper = bounds(structure, evidence)
    x = lower + (upper - lower) * rng.uniform(0.25, 0.75, (_STARTS, len(lower)))
    for i, name in enumerate(structure.names):
        if name == "w1":
            x[:, i] = np.log(evidence.omega[-1] * rng.uniform(0.8, FURTHER, _STARTS))
        elif name in ("w0", "wz"):
            x[:, i] = np.log(rng.choice(evidence.omega, _STARTS))
        elif name in ("z0", "z1", "zz"):
            x[:, i] = np.log(10.0 ** rng.uniform(-1.7, 0.0, _STARTS))
        elif name == "L":
            x[:, i] = rng.choice([0.01, 0.1, 0.5], _STARTS) / evidence.omega[-1]
    gain = np.abs(evidence.measured / responses(structure, x, evidence.omega))
    x[:, 0] += np.mean(np.log(gain), axis=1)
    margin = 1e-6 * (upper - lower)
    return np.clip(x, lower + margin, upper - margin), lower, upper


def _fit(structure: Structure, evidence: Evidence, rng: np.random.Generator) -> FloatArray:
    """Return the (K, P) parameters within the region that least squares ends at from several starts.

    Levenberg and Marquardt's method, for all starts at once; what would leave the bounds stays on them.
    """
    x, lower, upper = _starts(structure, evidence, rng)
    M, P = x.shape
    damping = np.full(M, 1e-2)
    step = 1e-6

    def residuals(values: FloatArray) -> FloatArray:
        return evidence.residuals(responses(structure, values, evidence.omega))

    r = residuals(x)
    cost = np.sum(r**2, axis=1)
    for _ in range(_ROUNDS):
        J = np.stack([(residuals(x + step * e) - r) / step for e in np.eye(P)], axis=-1)
        A, g = np.einsum("mip,miq->mpq", J, J), np.einsum("mip,mi->mp", J, r)
        held = ((x <= lower) & (g > 0.0)) | ((x >= upper) & (g < 0.0))
        A = np.where(held[:, :, None] | held[:, None, :], 0.0, A)
        scale = np.einsum("mpp->mp", A) + 1e-12 * np.max(np.abs(A), axis=(1, 2), initial=1e-300)[:, None]
        A = A + np.eye(P) * (damping[:, None] * scale)[:, None, :] + np.eye(P) * held[:, None, :]
        move = -np.linalg.solve(A + 1e-300 * np.eye(P), np.where(held, 0.0, g)[:, :, None])[:, :, 0]
        tried = np.clip(x + np.clip(move, -2.0, 2.0), lower, upper)
        there = residuals(tried)
        size = np.sum(there**2, axis=1)
        better = size < cost
        x, r = np.where(better[:, None], tried, x), np.where(better[:, None], there, r)
        cost = np.where(better, size, cost)
        damping = np.clip(np.where(better, damping * 0.3, damping * 5.0), 1e-12, 1e8)
    inside = (cost <= evidence.most) & are_admitted(structure, x, evidence)
    return np.asarray(x[inside])


def _sample(structure: Structure, evidence: Evidence, fitted: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return (M, P) parameters spread over the region: the stretch move of Goodman & Weare (2010), flat inside."""
    lower, upper = bounds(structure, evidence)

    def inside(x: FloatArray) -> BoolArray:
        within = np.all((x >= lower) & (x <= upper), axis=1) & are_admitted(structure, x, evidence)
        residuals = evidence.residuals(responses(structure, x, evidence.omega))
        return np.asarray(within & (np.sum(residuals**2, axis=1) <= evidence.most))

    walkers = fitted[rng.integers(len(fitted), size=_WALKERS)]
    for span in 10.0 ** -np.arange(1.0, 7.0):  # spread as far as each walker can be spread
        tried = walkers + span * rng.standard_normal(walkers.shape)
        alone = np.all(np.isin(walkers, fitted), axis=1)
        walkers = np.where((inside(tried) & alone)[:, None], tried, walkers)
    half, size = _WALKERS // 2, walkers.shape[1]
    kept = [fitted]
    for step in range(_STEPS):
        for mine, others in ((slice(0, half), slice(half, None)), (slice(half, None), slice(0, half))):
            z = (1.0 + rng.uniform(size=half)) ** 2 / 2.0
            partner = walkers[others][rng.integers(half, size=half)]
            tried = partner + z[:, None] * (walkers[mine] - partner)
            taken = inside(tried) & (rng.uniform(size=half) < z ** (size - 1))
            walkers[mine] = np.where(taken[:, None], tried, walkers[mine])
        if step % 40 == 39:
            kept.append(walkers.copy())
    return np.vstack(kept)


def _build_plant(structure: Structure, x: FloatArray, evidence: Evidence) -> TransferFunction:
    p, omega_0 = dict(zip(structure.names, x, strict=True)), evidence.omega_0
    num, den = np.array([evidence.sign * math.exp(p["b"])]), np.array([1.0])
    if structure.first == "integrator":
        num, den = num * omega_0, np.array([1.0, 0.0])
    elif structure.first == "lag":
        den = np.array([math.exp(p["T"]) / omega_0, 1.0])
    elif structure.first == "unstable":
        den = np.array([math.exp(p["T"]) / omega_0, -1.0])
    elif structure.first == "pair":
        den = np.polymul(den, _pair(p["w1"], p["z1"], omega_0))
    if structure.second == "lag":
        den = np.polymul(den, [math.exp(p["T2"]) / omega_0, 1.0])
    elif structure.second == "pair":
        den = np.polymul(den, _pair(p["w0"], p["z0"], omega_0))
    if structure.zero == "real":
        num = np.polymul(num, [math.sinh(p["a"]) / omega_0, 1.0])
    elif structure.zero == "pair":
        num = np.polymul(num, _pair(p["wz"], p["zz"], omega_0))
    return TransferFunction(num=tuple(num), den=tuple(den), delay_s=max(0.0, float(p["L"])) / omega_0)


def _pair(log_frequency: float, log_damping: float, omega_0: float) -> list[float]:
    w = omega_0 * math.exp(log_frequency)
    return [1.0 / w**2, 2.0 * math.exp(log_damping) / w, 1.0]


@dataclass(frozen=True, kw_only=True, eq=False)
class ConsistentStructures:
    """Plants of low order through the points.

    Attributes
    ----------
    plants : tuple of TransferFunction
        Members; empty where no structure passes through the points.
    nominal : TransferFunction or None
        Of the smallest structure the member closest to the points.
    structures : tuple of Structure
        Those that have members.
    omega_points : tuple of float
        Frequencies of the points, ascending [rad/s].
    """

    plants: tuple[TransferFunction, ...]
    nominal: TransferFunction | None
    structures: tuple[Structure, ...]
    omega_points: tuple[float, ...]


def consistent_structures(points: Sequence[FrequencyPoint]) -> ConsistentStructures:
    """Return plants of low order that pass through the joint region of the points.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        At least three, with covariance.
    """
    return _consistent(tuple(points))


@lru_cache(maxsize=4)
def _consistent(points: tuple[FrequencyPoint, ...]) -> ConsistentStructures:
    evidence = evidence_of(points, _PROBABILITY)
    rng = np.random.default_rng(0)
    plants: list[TransferFunction] = []
    structures: list[Structure] = []
    nominal: tuple[float, TransferFunction] | None = None
    least = 2 * len(points)
    for structure in STRUCTURES:
        size = len(structure.names)
        if size > min(least + _MORE, 2 * len(points) - 1):
            continue
        fitted = _fit(structure, evidence, rng)
        if not len(fitted):
            continue
        least = min(least, size)
        sample = _sample(structure, evidence, fitted, rng)
        plants += [_build_plant(structure, x, evidence) for x in sample[rng.permutation(len(sample))[:_KEPT]]]
        structures.append(structure)
        sizes = np.sum(evidence.residuals(responses(structure, fitted, evidence.omega)) ** 2, axis=1)
        criterion = float(np.min(sizes)) + size * math.log(2 * len(points))
        if nominal is None or criterion < nominal[0]:
            nominal = (criterion, _build_plant(structure, fitted[int(np.argmin(sizes))], evidence))
    return ConsistentStructures(
        plants=tuple(plants),
        nominal=None if nominal is None else nominal[1],
        structures=tuple(structures),
        omega_points=tuple(float(w) for w in evidence.omega * evidence.omega_0),
    )
