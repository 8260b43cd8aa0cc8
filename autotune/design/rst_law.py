"""An RST controller as it runs: difference equations in T r - R y with limits, as a pure step function.

R/S and T/S are discretised by Tustin's rule s -> 2/T_s (1 - q^-1)/(1 + q^-1), which keeps their static gains:

    v[k] = sum t_i r[k-i] - sum r_i y[k-i] - sum (s_i - a_i) u[k-i] - sum a_i v[k-i]
    u[k] = v[k] held to the limits

Between the limits u = v and the observer polynomial A_o = 1 + a_1 q^-1 + ... drops out. It has the roots of S, but for
the integrator's, which is put at exp(-T_s/T_t): the integral follows a limited command with time constant T_t.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.signal import bilinear

from autotune.arrays import FloatArray
from autotune.controller import DiscreteController
from autotune.design.rst import RST
from autotune.errors import DesignError, InputError


@dataclass(frozen=True, kw_only=True)
class RSTState:
    """Past set-points, measurements [y unit] and wanted and given commands [u unit], the latest first."""

    r: tuple[float, ...]
    y: tuple[float, ...]
    v: tuple[float, ...]
    u: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class RSTLaw:
    """Discrete RST with output limits.

    Attributes
    ----------
    controller : RST
        Proper R/S and T/S with integral action.
    sample_time_s : float
        Time between two calls of :meth:`step` [s].
    u_min, u_max : float
        Limits of the command [u unit].
    tracking_time_s : float, optional
        T_t [s]; where absent that of the slowest root of R, as T_I is of a PI.

    Raises
    ------
    InputError
        A sample time that is not positive, or limits out of order.
    DesignError
        R or T of higher degree than S, S without a root at 0 or with one in the right half plane, or no tracking time
        for an R without roots.

    Notes
    -----
    The margins of the law as it runs, hold included, are those of :func:`autotune.design.margins.margins` with
    :meth:`discrete` as the controller.

    References
    ----------
    Astrom & Wittenmark 1997, Computer-Controlled Systems, section 9.4 (anti-windup of a polynomial controller).
    """

    controller: RST
    sample_time_s: float
    u_min: float = -math.inf
    u_max: float = math.inf
    tracking_time_s: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.sample_time_s < math.inf:
            raise InputError(f"sample time = {self.sample_time_s:g} s", where="RST law", remedy="it must be positive")
        if not self.u_min < self.u_max:
            raise InputError(f"u_min = {self.u_min:g} is not below u_max = {self.u_max:g}", where="RST law")
        c = self.controller
        if max(len(c.R), len(c.T)) > len(c.S) or c.S[-1] != 0.0:
            raise DesignError("R/S and T/S must be proper, with a root of S at 0", where="RST law")
        if np.any(np.roots(c.S[:-1]).real >= 0.0):
            raise DesignError("S has a second root at 0 or one in the right half plane", where="RST law")
        if len(c.R) == 1 and self.tracking_time_s is None:
            raise DesignError("R has no root to take the tracking time from", where="RST law", remedy="give one")
        if self.tracking_time_s is not None and not self.tracking_time_s > 0.0:
            raise InputError(f"tracking time = {self.tracking_time_s:g} s", where="RST law", remedy="make it positive")

    @cached_property
    def coefficients(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """R, S, T in ascending powers of q^-1, S beginning with 1, each of S's length."""
        c = self.controller
        R, S = bilinear(c.R, c.S, 1.0 / self.sample_time_s)
        T, _ = bilinear(c.T, c.S, 1.0 / self.sample_time_s)
        return np.asarray(R), np.asarray(S), np.asarray(T)

    @cached_property
    def observer(self) -> FloatArray:
        """A_o in ascending powers of q^-1, of S's length and beginning with 1."""
        c = self.controller
        tracking = self.tracking_time_s
        if tracking is None:
            tracking = 1.0 / float(np.min(np.abs(np.roots(c.R))))
        half = 0.5 * self.sample_time_s * np.roots(c.S[:-1])
        roots = np.append((1.0 + half) / (1.0 - half), math.exp(-self.sample_time_s / tracking))
        return np.asarray(np.real(np.poly(roots)))

    def initial(self, u: float, r: float, _y: float) -> RSTState:
        """Return the state of a loop that has long rested at r under u: bumpless where y is at r.

        Parameters
        ----------
        u : float
            Command [u unit].
        r : float
            Set-point [y unit].
        _y : float
            Measurement [y unit]; not used.
        """
        past = len(self.controller.S) - 1
        held = min(max(u, self.u_min), self.u_max)
        return RSTState(r=(r,) * past, y=(r,) * past, v=(held,) * past, u=(held,) * past)

    def step(self, state: RSTState, r: float, y: float) -> tuple[float, RSTState]:
        """Return the command for this sample, within the limits, and the state for the next.

        Parameters
        ----------
        state : RSTState
            After the sample before.
        r, y : float
            Set-point and measurement [y unit].

        Raises
        ------
        InputError
            One of them is not finite.
        """
        if not (math.isfinite(r) and math.isfinite(y)):
            raise InputError(f"set-point {r} and measurement {y}", where="RST law", remedy="both must be finite")
        R, S, T = self.coefficients
        rs, ys, limited = (r, *state.r), (y, *state.y), np.array(state.u) - np.array(state.v)
        # sum (s_i - a_i) u + sum a_i v = sum s_i u - sum a_i (u - v)
        v = float(T @ np.array(rs) - R @ np.array(ys) - S[1:] @ np.array(state.u) + self.observer[1:] @ limited)
        u = min(max(v, self.u_min), self.u_max)
        return u, RSTState(r=rs[:-1], y=ys[:-1], v=(v, *state.v[:-1]), u=(u, *state.u[:-1]))

    def to_json(self) -> dict[str, Any]:
        """Return R, S, T and the observer in ascending powers of q^-1, as ``autotune rst`` writes them."""
        R, S, T = self.coefficients
        polynomials = {"R": R.tolist(), "S": S.tolist(), "T": T.tolist(), "observer": self.observer.tolist()}
        return {"sample_time_s": self.sample_time_s} | polynomials

    def discrete(self) -> DiscreteController:
        """Return the feedback R/S between its limits as C(q), without the hold."""
        R, S, _ = self.coefficients
        return DiscreteController(num=tuple(R.tolist()), den=tuple(S.tolist()), sample_time_s=self.sample_time_s)
