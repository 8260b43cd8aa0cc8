"""The law as it will run: discrete PI or PID with limits, anti-windup and bumpless transfer, as a pure step function.

Every continuous term is discretised by the backward difference s -> (1 - q^-1)/T_s, so the law is exactly C(s) of
:class:`autotune.controller.PIDController` at that s, for any filter time constant down to zero:

    y_f[k] = y_f[k-1] + T_s/(T_f + T_s) (y[k] - y_f[k-1])
    I[k]   = I[k-1] + K T_s/T_I (r[k] - y_f[k])
    v[k]   = K (b r[k] - y_f[k]) + I[k] - K T_d (y_f[k] - y_f[k-1])/T_s
    u[k]   = v[k] held to the limits of u and of its rate
    I[k]  += T_s/T_t (u[k] - v[k])
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.controller import DiscreteController, PIDController
from autotune.errors import InputError


@dataclass(frozen=True, kw_only=True)
class LawState:
    """What the law remembers between two samples.

    Attributes
    ----------
    integral : float
        Integral part I, in units of u; holds the operating point's command too.
    y_filtered : float
        Filtered measurement y_f.
    u : float
        Command of the last sample, from which the rate limit counts.
    """

    integral: float
    y_filtered: float
    u: float


@dataclass(frozen=True, kw_only=True)
class PILaw:
    """Discrete PI or PID with output and rate limits; anti-windup by back-calculation.

    Attributes
    ----------
    controller : PIDController
        Gains, filter and set-point weight.
    sample_time_s : float
        Time between two calls of :meth:`step` [s].
    u_min, u_max : float
        Limits of the command [u unit].
    u_rate : float
        Largest change of the command per second [u unit/s].
    tracking_time_s : float, optional
        Time constant T_t with which the integral follows a limited command [s]; T_I of a PI, sqrt(T_I T_d) of a PID
        where absent, never below the sample time.

    Raises
    ------
    InputError
        A sample time or a rate that is not positive, limits out of order, or a measurement that is not finite.

    Notes
    -----
    The backward difference leads the continuous law by up to omega T_s/2 in its integral and lags it in its filter;
    the margins of the law as it runs, hold included, are those of :func:`autotune.design.margins.margins` with
    :meth:`discrete` as the controller.
    """

    controller: PIDController
    sample_time_s: float
    u_min: float = -math.inf
    u_max: float = math.inf
    u_rate: float = math.inf
    tracking_time_s: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.sample_time_s < math.inf:
            raise InputError(
                f"sample time = {self.sample_time_s:g} s", where="control law", remedy="it must be positive"
            )
        if not self.u_min < self.u_max:
            raise InputError(f"u_min = {self.u_min:g} is not below u_max = {self.u_max:g}", where="control law")
        if not self.u_rate > 0.0:
            raise InputError(f"u_rate = {self.u_rate:g}", where="control law", remedy="it must be positive")
        if self.tracking_time_s is not None and not self.tracking_time_s > 0.0:
            raise InputError(
                f"tracking time = {self.tracking_time_s:g} s", where="control law", remedy="make it positive"
            )

    @property
    def tracking_gain(self) -> float:
        """T_s/T_t, at most 1; zero without integral action."""
        c = self.controller
        if math.isinf(c.Ti_s):
            return 0.0
        tracking = self.tracking_time_s
        if tracking is None:
            tracking = math.sqrt(c.Ti_s * c.Td_s) if c.Td_s > 0.0 else c.Ti_s
        return self.sample_time_s / max(tracking, self.sample_time_s)

    def initial(self, u: float, r: float, y: float) -> LawState:
        """Return the state from which the next :meth:`step` with the same r and y answers u: bumpless transfer.

        Parameters
        ----------
        u : float
            Command the actuator holds now [u unit]; brought within the limits.
        r, y : float
            Set-point and measurement now [y unit].

        Returns
        -------
        LawState
            Frozen; at rest with respect to y.
        """
        c = self.controller
        u = min(max(u, self.u_min), self.u_max)
        slope = 0.0 if math.isinf(c.Ti_s) else c.K * self.sample_time_s / c.Ti_s
        integral = u - c.K * (c.setpoint_weight * r - y) - slope * (r - y)
        return LawState(integral=integral, y_filtered=y, u=u)

    def step(self, state: LawState, r: float, y: float) -> tuple[float, LawState]:
        """Return the command for this sample and the state for the next.

        Parameters
        ----------
        state : LawState
            From :meth:`initial` or the previous step.
        r, y : float
            Set-point and measurement of this sample [y unit].

        Returns
        -------
        u : float
            Command within the output limits; within the rate limit too, where the last one was within them.
        state : LawState
            For the next sample.
        """
        if not (math.isfinite(r) and math.isfinite(y)):
            raise InputError(f"set-point {r} and measurement {y}", where="control law", remedy="both must be finite")
        c, T_s = self.controller, self.sample_time_s
        y_f = state.y_filtered + T_s / (c.Tf_s + T_s) * (y - state.y_filtered)
        slope = 0.0 if math.isinf(c.Ti_s) else c.K * T_s / c.Ti_s
        integral = state.integral + slope * (r - y_f)
        v = c.K * (c.setpoint_weight * r - y_f) + integral - c.K * c.Td_s * (y_f - state.y_filtered) / T_s
        move = self.u_rate * T_s
        u = min(max(v, state.u - move), state.u + move)
        u = min(max(u, self.u_min), self.u_max)
        return u, LawState(integral=integral + self.tracking_gain * (u - v), y_filtered=y_f, u=u)

    def discrete(self) -> DiscreteController:
        """Return the law between its limits as C(q) acting on r - y (set-point weight 1), without the hold."""
        c, T_s = self.controller, self.sample_time_s
        difference = np.array([1.0, -1.0]) / T_s
        if math.isinf(c.Ti_s):
            num = np.array([c.K, 0.0]) + c.K * c.Td_s * difference
            den = np.array([1.0, 0.0]) + c.Tf_s * difference
        else:
            # K (1 + 1/(T_I s) + T_d s)/(1 + T_f s) times s over s
            num = c.K * (np.array([1.0 / c.Ti_s, 0.0, 0.0]) + np.append(difference, 0.0))
            num = num + c.K * c.Td_s * np.convolve(difference, difference)
            den = np.convolve(difference, np.array([1.0, 0.0]) + c.Tf_s * difference)
        while len(num) > 1 and num[-1] == 0.0 and den[-1] == 0.0:
            num, den = num[:-1], den[:-1]
        return DiscreteController(
            num=tuple(float(b) for b in num / den[0]), den=tuple(float(a) for a in den / den[0]), sample_time_s=T_s
        )
