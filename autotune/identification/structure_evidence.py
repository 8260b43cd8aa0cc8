"""Structures of low order and what points say of their parameters: distances, bounds, which plants are admitted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Literal, TypeAlias

import numpy as np

from autotune.arrays import BoolArray, ComplexArray, FloatArray
from autotune.distributions import chi2_quantile
from autotune.points import FrequencyPoint

First: TypeAlias = Literal["none", "integrator", "lag", "unstable", "pair"]
Second: TypeAlias = Literal["none", "lag", "pair"]
Zero: TypeAlias = Literal["none", "real", "pair"]

#: what a structure of low order need not represent, as a share of the gain
_RESOLUTION = 1e-3
#: damping above which a pair of roots may lie anywhere
_AUDIBLE = 0.4
#: where a lightly damped pair may lie, times the lowest and the highest frequency
_BELOW, _ABOVE = 0.5, 1.3
#: how far a second pair may lie, times the highest frequency, and its least damping
FURTHER, _DAMPED = 3.0, 0.1


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
        most=chi2_quantile(probability, 2 * len(ordered)),
    )


def responses(structure: Structure, x: FloatArray, omega: FloatArray) -> ComplexArray:
    """Return the responses of plants of a structure.

    Parameters
    ----------
    structure : Structure
        P parameters.
    x : (M, P) array
        Their values, in units of omega_0.
    omega : (N,) array
        Frequencies over omega_0.

    Returns
    -------
    (M, N) complex array
        The responses.
    """
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


def bounds(structure: Structure, evidence: Evidence) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and the highest value of every parameter of a structure.

    Parameters
    ----------
    structure : Structure
        P parameters.
    evidence : Evidence
        Frequencies and responses.

    Returns
    -------
    tuple of (P,) array
        The two ends.
    """
    first, last = evidence.omega[0], evidence.omega[-1]
    size = float(np.log(np.max(np.abs(evidence.measured))))
    ranges = {
        "b": (size - 16.0, size + 16.0),
        "L": (0.0, 2.0 * math.pi / first),
        "T": (math.log(0.03 / last), math.log(100.0 / first)),
        "T2": (math.log(0.03 / last), math.log(30.0 / first)),
        "w0": (math.log(0.1 * first), math.log(10.0 * last)),
        "z0": (math.log(2e-3), math.log(3.0)),
        "w1": (math.log(0.1 * first), math.log(FURTHER * last)),
        "z1": (math.log(_DAMPED), math.log(3.0)),
        "a": (0.0 if structure.first == "unstable" else -math.asinh(10.0 / first), math.asinh(10.0 / first)),
        "wz": (math.log(0.1 * first), math.log(10.0 * last)),
        "zz": (math.log(2e-3), math.log(3.0)),
    }
    limits = np.array([ranges[name] for name in structure.names])
    return limits[:, 0], limits[:, 1]


def are_admitted(structure: Structure, x: FloatArray, evidence: Evidence) -> BoolArray:
    """Return whether parameters are of the class: where a lightly damped pair is, and the phase's turn.

    Parameters
    ----------
    structure : Structure
        P parameters.
    x : (M, P) array
        Their values, in units of omega_0.
    evidence : Evidence
        Frequencies and responses.

    Returns
    -------
    (M,) array of bool
        Which are.
    """
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
