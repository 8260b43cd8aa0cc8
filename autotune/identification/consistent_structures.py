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
from functools import cached_property, lru_cache
from itertools import product
from typing import Literal, TypeAlias

import numpy as np
from scipy.stats import chi2

from autotune.arrays import BoolArray, ComplexArray, FloatArray
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint

First: TypeAlias = Literal["none", "integrator", "lag", "unstable", "pair"]
Second: TypeAlias = Literal["none", "lag", "pair"]
Zero: TypeAlias = Literal["none", "real", "pair"]

#: what a structure of low order need not represent, as a share of the gain
_RESOLUTION = 1e-3
#: structures with so many more parameters than the smallest that fits are members too
_MORE = 2
#: damping above which a pair of roots may lie anywhere
_AUDIBLE = 0.4
#: where a lightly damped pair may lie, times the lowest and the highest frequency
_BELOW, _ABOVE = 0.5, 1.3
#: how far a second pair may lie, times the highest frequency, and its least damping
_FURTHER, _DAMPED = 3.0, 0.1
_WALKERS, _STEPS, _KEPT = 48, 400, 64
_STARTS, _ROUNDS = 12, 60


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Which factors a plant has.

    Attributes
    ----------
    first : {"none", "integrator", "lag", "unstable", "pair"}
        Pole at 0, in the left or in the right half plane; or a pair beside the one of ``second``.
    second : {"none", "lag", "pair"}
        Further poles.
    zero : {"none", "real", "pair"}
        Numerator.
    """

    first: First
    second: Second
    zero: Zero

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in their order; all but L and a are logarithms."""
        found = ["b", "L"]
        found += {"lag": ["T"], "unstable": ["T"], "pair": ["w1", "z1"]}.get(self.first, [])
        found += {"none": [], "lag": ["T2"], "pair": ["w0", "z0"]}[self.second]
        return tuple(found + {"none": [], "real": ["a"], "pair": ["wz", "zz"]}[self.zero])

    @property
    def is_member(self) -> bool:
        """Whether the structure is strictly proper, and none that another one is already."""
        if self.first == "pair":
            return self.second == "pair"
        poles = (self.first != "none") + {"none": 0, "lag": 1, "pair": 2}[self.second]
        zeros = {"none": 0, "real": 1, "pair": 2}[self.zero]
        return poles > zeros and not (self.first == "none" and self.second == "lag")


STRUCTURES = tuple(
    sorted(
        (
            structure
            for first, second, zero in product(
                ("none", "integrator", "lag", "unstable", "pair"), ("none", "lag", "pair"), ("none", "real", "pair")
            )
            if (structure := Structure(first=first, second=second, zero=zero)).is_member  # type: ignore[arg-type]
        ),
        key=lambda structure: len(structure.names),
    )
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """Points, whitened, in units of their middle frequency.

    Attributes
    ----------
    omega : (N,) array
        Frequencies over ``omega_0``.
    measured : (N,) complex array
        Gains, sign taken out.
    whitener : (N, 2, 2) array
        W with W cov W^T = I.
    omega_0 : float
        Unit of frequency [rad/s].
    sign : float
        Of the gain that a stabilising PI has: the lowest point's phase lies between -180 and 0 degrees without it.
    most : float
        Largest weighted squared distance of a member from the points.
    """

    omega: FloatArray
    measured: ComplexArray
    whitener: FloatArray
    omega_0: float
    sign: float
    most: float

    def residuals(self, response: ComplexArray) -> FloatArray:
        """Return (..., 2 N) whitened residuals of (..., N) responses."""
        error = response - self.measured
        parts = np.stack([error.real, error.imag], axis=-1)
        return np.asarray(np.einsum("nij,...nj->...ni", self.whitener, parts)).reshape(*error.shape[:-1], -1)


def evidence_of(points: Sequence[FrequencyPoint], probability: float) -> Evidence:
    """Return the points whitened, with the distance within which the plant lies at a probability.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        At least one, with covariance.
    probability : float
        Of the region, between 0 and 1.
    """
    ordered = sorted(points, key=lambda point: point.omega_rad_s)
    omega = np.array([point.omega_rad_s for point in ordered])
    omega_0 = float(np.exp(np.mean(np.log(omega))))
    sign = -1.0 if ordered[0].phase_rad > 0.0 else 1.0
    floors = [np.array(point.covariance) + (_RESOLUTION * point.gain) ** 2 * np.eye(2) for point in ordered]
    return Evidence(
        omega=omega / omega_0,
        measured=np.array([sign * point.response for point in ordered], dtype=np.complex128),
        sign=sign,
        whitener=np.array([np.linalg.inv(np.linalg.cholesky(covariance)) for covariance in floors]),
        omega_0=omega_0,
        most=float(chi2.ppf(probability, 2 * len(ordered))),
    )


def _responses(structure: Structure, x: FloatArray, omega: FloatArray) -> ComplexArray:
    """Return (M, N) responses of (M, P) parameters, frequencies in units of omega_0."""
    s = 1j * omega[None, :]
    p = {name: x[:, i, None] for i, name in enumerate(structure.names)}
    H = np.exp(p["b"] - s * p["L"])
    if structure.first == "integrator":
        H = H / s
    elif structure.first == "lag":
        H = H / (1.0 + s * np.exp(p["T"]))
    elif structure.first == "unstable":
        H = H / (s * np.exp(p["T"]) - 1.0)
    elif structure.first == "pair":
        w = s / np.exp(p["w1"])
        H = H / (1.0 + 2.0 * np.exp(p["z1"]) * w + w * w)
    if structure.second == "lag":
        H = H / (1.0 + s * np.exp(p["T2"]))
    elif structure.second == "pair":
        w = s / np.exp(p["w0"])
        H = H / (1.0 + 2.0 * np.exp(p["z0"]) * w + w * w)
    if structure.zero == "real":
        H = H * (1.0 + s * np.sinh(p["a"]))
    elif structure.zero == "pair":
        w = s / np.exp(p["wz"])
        H = H * (1.0 + 2.0 * np.exp(p["zz"]) * w + w * w)
    return np.asarray(H)


def _bounds(structure: Structure, evidence: Evidence) -> tuple[FloatArray, FloatArray]:
    first, last = evidence.omega[0], evidence.omega[-1]
    size = float(np.log(np.max(np.abs(evidence.measured))))
    ranges = {
        "b": (size - 16.0, size + 16.0),
        "L": (0.0, 2.0 * math.pi / first),
        "T": (math.log(0.03 / last), math.log(100.0 / first)),
        "T2": (math.log(0.03 / last), math.log(30.0 / first)),
        "w0": (math.log(0.1 * first), math.log(10.0 * last)),
        "z0": (math.log(2e-3), math.log(3.0)),
        "w1": (math.log(0.1 * first), math.log(_FURTHER * last)),
        "z1": (math.log(_DAMPED), math.log(3.0)),
        "a": (0.0 if structure.first == "unstable" else -math.asinh(10.0 / first), math.asinh(10.0 / first)),
        "wz": (math.log(0.1 * first), math.log(10.0 * last)),
        "zz": (math.log(2e-3), math.log(3.0)),
    }
    limits = np.array([ranges[name] for name in structure.names])
    return limits[:, 0], limits[:, 1]


def _admitted(structure: Structure, x: FloatArray, evidence: Evidence) -> BoolArray:
    """Return whether (M, P) parameters are of the class: where a lightly damped pair is, and the phase's turn."""
    first, last = evidence.omega[0], evidence.omega[-1]
    p = {name: x[:, i] for i, name in enumerate(structure.names)}
    inside = np.ones(len(x), dtype=bool)
    phase = -first * p["L"]  # at the first point, counted from frequency 0
    for frequency, damping, turn in (("w0", "z0", -1.0), ("wz", "zz", 1.0)):
        if frequency in p:
            w = np.exp(p[frequency])
            inside &= ((w >= _BELOW * first) & (w <= _ABOVE * last)) | (p[damping] >= math.log(_AUDIBLE))
            phase = phase + turn * np.arctan2(2.0 * np.exp(p[damping]) * first / w, 1.0 - (first / w) ** 2)
    if structure.first == "pair":
        w = np.exp(p["w1"])
        phase = phase - np.arctan2(2.0 * np.exp(p["z1"]) * first / w, 1.0 - (first / w) ** 2)
    elif structure.first == "integrator":
        phase = phase - 0.5 * np.pi
    elif structure.first != "none":
        phase = phase - np.arctan(first * np.exp(p["T"])) * (1.0 if structure.first == "lag" else -1.0)
        phase = phase - (np.pi if structure.first == "unstable" else 0.0)
    if "T2" in p:
        phase = phase - np.arctan(first * np.exp(p["T2"]))
    if "a" in p:
        phase = phase + np.arctan(first * np.sinh(p["a"]))
    return np.asarray(inside & (phase > -np.pi) & (phase <= 0.5 * np.pi))


def _starts(structure: Structure, evidence: Evidence, rng: np.random.Generator) -> tuple[FloatArray, ...]:
    """Return (K, P) starting values all over the bounds, and the bounds."""
    lower, upper = _bounds(structure, evidence)
    x = lower + (upper - lower) * rng.uniform(0.25, 0.75, (_STARTS, len(lower)))
    for i, name in enumerate(structure.names):
        if name == "w1":
            x[:, i] = np.log(evidence.omega[-1] * rng.uniform(0.8, _FURTHER, _STARTS))
        elif name in ("w0", "wz"):
            x[:, i] = np.log(rng.choice(evidence.omega, _STARTS))
        elif name in ("z0", "z1", "zz"):
            x[:, i] = np.log(10.0 ** rng.uniform(-1.7, 0.0, _STARTS))
        elif name == "L":
            x[:, i] = rng.choice([0.01, 0.1, 0.5], _STARTS) / evidence.omega[-1]
    gain = np.abs(evidence.measured / _responses(structure, x, evidence.omega))
    x[:, 0] += np.mean(np.log(gain), axis=1)
    margin = 1e-6 * (upper - lower)
    return np.clip(x, lower + margin, upper - margin), lower, upper


def _fitted(structure: Structure, evidence: Evidence, rng: np.random.Generator) -> FloatArray:
    """Return the (K, P) parameters within the region that least squares ends at from several starts.

    Levenberg and Marquardt's method, for all starts at once; what would leave the bounds stays on them.
    """
    x, lower, upper = _starts(structure, evidence, rng)
    M, P = x.shape
    damping = np.full(M, 1e-2)
    step = 1e-6

    def residuals(values: FloatArray) -> FloatArray:
        return evidence.residuals(_responses(structure, values, evidence.omega))

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
    inside = (cost <= evidence.most) & _admitted(structure, x, evidence)
    return np.asarray(x[inside])


def _sampled(structure: Structure, evidence: Evidence, fitted: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return (M, P) parameters spread over the region: the stretch move of Goodman & Weare (2010), flat inside."""
    lower, upper = _bounds(structure, evidence)

    def inside(x: FloatArray) -> BoolArray:
        within = np.all((x >= lower) & (x <= upper), axis=1) & _admitted(structure, x, evidence)
        residuals = evidence.residuals(_responses(structure, x, evidence.omega))
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


def _built(structure: Structure, x: FloatArray, evidence: Evidence) -> TransferFunction:
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


def consistent_structures(points: Sequence[FrequencyPoint], *, probability: float = 0.99) -> ConsistentStructures:
    """Return plants of low order that pass through the joint region of the points.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        At least three, with covariance.
    probability : float
        Of the joint region of all points.
    """
    return _consistent(tuple(points), probability)


@lru_cache(maxsize=4)
def _consistent(points: tuple[FrequencyPoint, ...], probability: float) -> ConsistentStructures:
    evidence = evidence_of(points, probability)
    rng = np.random.default_rng(0)
    plants: list[TransferFunction] = []
    structures: list[Structure] = []
    nominal: tuple[float, TransferFunction] | None = None
    least = 2 * len(points)
    for structure in STRUCTURES:
        size = len(structure.names)
        if size > min(least + _MORE, 2 * len(points) - 1):
            continue
        fitted = _fitted(structure, evidence, rng)
        if not len(fitted):
            continue
        least = min(least, size)
        sample = _sampled(structure, evidence, fitted, rng)
        plants += [_built(structure, x, evidence) for x in sample[rng.permutation(len(sample))[:_KEPT]]]
        structures.append(structure)
        sizes = np.sum(evidence.residuals(_responses(structure, fitted, evidence.omega)) ** 2, axis=1)
        criterion = float(np.min(sizes)) + size * math.log(2 * len(points))
        if nominal is None or criterion < nominal[0]:
            nominal = (criterion, _built(structure, fitted[int(np.argmin(sizes))], evidence))
    return ConsistentStructures(
        plants=tuple(plants),
        nominal=None if nominal is None else nominal[1],
        structures=tuple(structures),
        omega_points=tuple(float(w) for w in evidence.omega * evidence.omega_0),
    )
