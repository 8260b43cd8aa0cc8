"""The model with an input delay that the delay identification estimates, its covariance and its file."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import InputError
from autotune.identification.noise_filter import Whitening
from autotune.models import TransferFunction
from autotune.text_files import read_json


@dataclass(frozen=True, kw_only=True, eq=False)
class DelayModel:
    """x^(n) = sum a_i x^(i) + b u(t - h) + d, y = x + noise: the sign convention of Ollivier et al. (2007).

    Attributes
    ----------
    a : tuple of n floats
        a_0..a_{n-1} [1/s^(n-i)].
    b : float
        Input gain [y unit/u unit/s^n].
    delay_s : float
        Delay h of the input [s].
    constant : float
        d [y unit/s^n]: a constant offset of y, of u, or a constant load; 0 where it was not estimated.
    initial_time_s, initial_state : float, tuple of n floats
        Time stamp [s] and x, x', .. at that time [y unit/s^i].
    covariance : (2n+3, 2n+3) array
        Of (a_0.., b, delay, constant, initial state); zero rows for what was fixed,
        NaN for what has a value but no covariance.
    noise_sd : float
        Standard deviation of the noise on y, or of its innovation where it is coloured [y unit].
    noise_ar, noise_ma : tuple of float
        c_1.. and d_1.. of the noise model (1 + c_1 q^-1 + ..) w = (1 + d_1 q^-1 + ..) innovation, q^-1 the previous
        row; both empty for white noise, the latter where no load wanders.
    rows : int
        Rows of y the fit used.
    """

    a: tuple[float, ...]
    b: float
    delay_s: float
    constant: float
    initial_time_s: float
    initial_state: tuple[float, ...]
    covariance: FloatArray
    noise_sd: float
    noise_ar: tuple[float, ...] = ()
    noise_ma: tuple[float, ...] = ()
    rows: int = 0

    @property
    def order(self) -> int:
        """Order n."""
        return len(self.a)

    @property
    def whitening(self) -> Whitening:
        """The filter that makes the noise white."""
        return Whitening(ar=np.array(self.noise_ar), ma=np.array(self.noise_ma))

    @property
    def standard_deviations(self) -> FloatArray:
        """Standard deviations of (a_0.., b, delay, constant, initial state), 0 for what was fixed."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def values(self) -> FloatArray:
        """The parameters in the order of the covariance."""
        return np.array([*self.a, self.b, self.delay_s, self.constant, *self.initial_state])

    def transfer_function(self) -> TransferFunction:
        """Return b exp(-s h) / (s^n - a_{n-1} s^(n-1) - .. - a_0)."""
        return TransferFunction(num=(self.b,), den=(1.0, *(-value for value in self.a[::-1])), delay_s=self.delay_s)

    @property
    def poles(self) -> ComplexArray:
        """Roots of s^n - sum a_i s^i [rad/s], slowest first."""
        roots = np.roots([1.0, *(-value for value in self.a[::-1])])
        return np.asarray(roots[np.argsort(np.abs(roots))], dtype=np.complex128)

    def to_json(self) -> dict[str, Any]:
        """Return the fixed form of ``delay.json``, with the constant, its sd and the noise besides."""
        n = self.order
        sd = self.standard_deviations
        return {
            "order": n,
            "a": list(self.a),
            "b": [self.b],
            "delay_s": self.delay_s,
            "initial_state": list(self.initial_state),
            "sd": {"a": _or_null(sd[:n]), "b": _or_null(sd[n : n + 1]), "delay_s": _or_null(sd)[n + 1]},
            "constant": self.constant,
            "constant_sd": _or_null(sd)[n + 2],
            "initial_time_s": self.initial_time_s,
            "initial_state_sd": _or_null(sd[n + 3 :]),
            "covariance": [_or_null(row) for row in self.covariance],
            "noise": {"sd": self.noise_sd, "ar": list(self.noise_ar), "ma": list(self.noise_ma)},
            "rows": self.rows,
        }


def _or_null(values: FloatArray) -> list[float | None]:
    """Return numbers for JSON, null for what has none."""
    return [float(value) if math.isfinite(value) else None for value in values]


def read_delay_model(path: str | os.PathLike[str]) -> DelayModel:
    """Read ``delay.json``; where only the fixed keys are there, the covariance is the diagonal of the sds.

    Raises
    ------
    InputError
        No such file, not JSON, or a missing key.
    """
    where = str(path)
    content = read_json(path)
    try:
        a = tuple(float(value) for value in content["a"])
        b = float(content["b"][0])
        delay_s = float(content["delay_s"])
        sd = [*content["sd"]["a"], *content["sd"]["b"], content["sd"]["delay_s"]]
        initial_state = tuple(float(value) for value in content.get("initial_state", [0.0] * len(a)))
        diagonal = np.array([*sd, *[0.0] * (1 + len(a))], dtype=np.float64) ** 2
        covariance = np.array(content.get("covariance", np.diag(diagonal)), dtype=np.float64)  # null is NaN
        noise = content.get("noise", {})
        rest = {key: float(content.get(key, 0.0)) for key in ("constant", "initial_time_s")}
        noise_sd = float(noise.get("sd") or math.nan)
        noise_ar, noise_ma = (tuple(float(value) for value in noise.get(key, ())) for key in ("ar", "ma"))
        rows = int(content.get("rows", 0))
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError):
        raise InputError(
            "is not a delay file with order, a, b, delay_s, initial_state, sd",
            where=where,
            remedy="write it with autotune identify delay",
        ) from None
    if not a or covariance.shape != (2 * len(a) + 3,) * 2 or not np.all(np.isfinite((*a, b, delay_s))):
        raise InputError("a, b, delay_s and sd do not belong together", where=where)
    return DelayModel(
        a=a,
        b=b,
        delay_s=delay_s,
        constant=rest["constant"],
        initial_time_s=rest["initial_time_s"],
        initial_state=initial_state,
        covariance=covariance,
        noise_sd=noise_sd,
        noise_ar=noise_ar,
        noise_ma=noise_ma,
        rows=rows,
    )
