"""On-line identification by modulating functions with exponential forgetting: Ollivier et al. (2007), sections 2 and 4.

Kernels g_j(t) = (T - t)^j exp(-lambda (T - t)) up to the current time T; their integrals J_j = I_{x,g_j} obey
J_0' = x - lambda J_0, J_j' = j J_{j-1} - lambda J_j, and d g_j/dt = lambda g_j - j g_{j-1} gives those of the
derivatives. The kernels with j >= n vanish at T together with n - 1 derivatives and give the parameters; those with
j < n give the state. The equations C A = D are not solved but followed by the gradient flow
A' = -Lambda C^T (C A - D), which is stiff: explicit Euler steps diverge at 100 Hz, so the steps are implicit.

Misprints of the paper: in section 4 the second column is b_1 I_{u,f'}, not b_1 I_{u,f}; the factor in the delayed
input's chain is (1 - lambda_h b_1/b_0), with the printed plus sign the estimate loses lock. Here the chain of u is
evaluated at t - h exactly, from its stored past, and needs no factor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arguments import check_arguments
from autotune.arrays import FloatArray, is_real
from autotune.errors import IdentificationError, InputError
from autotune.identification.delay import online_chain as chain
from autotune.recording import Recording

#: Rows of u's past that are made room for at once.
_ROOM = 4096
#: Highest order: the chain of kernels t^j exp(-t) loses its digits beyond.
_MOST_ORDER = 20


@dataclass(frozen=True, kw_only=True)
class DelayTracking:
    """How the delay is followed.

    Attributes
    ----------
    start_s : float
        Delay the tracking begins with [s]; the true one must be near, compared with 1/lambda.
    after_s : float
        T_0: time from the first row until which the delay is held at its start [s].
    rate : float
        lambda_h: share of the correction b_1/b_0 taken per second [1/s].
    longest_s : float
        Longest delay that u's past is kept for [s]; all of it by default.
    """

    start_s: float = 0.0
    after_s: float
    rate: float
    longest_s: float = np.inf


@dataclass(frozen=True, kw_only=True, eq=False)
class OnlineEstimate:
    """Estimates row by row.

    Attributes
    ----------
    t : (N,) array
        Time stamps [s].
    a : (N, n) array
        a_0..a_{n-1}.
    b, delay_s : (N,) array
        Input gain and delay [s].
    state : (N, n) array
        x, x', .. at each row; NaN until the kernels have filled.
    covariance : (N, n + 2, n + 2) array
        Of (a_0.., b, delay), so that 1.96 standard deviations are a 95 % interval; NaN until the equations have been
        averaged for three times the memory, and with the paper's scalar gain; zero for a delay that is not followed.
    """

    t: FloatArray
    a: FloatArray
    b: FloatArray
    delay_s: FloatArray
    state: FloatArray
    covariance: FloatArray

    @property
    def standard_deviations(self) -> FloatArray:
        """Of (a_0.., b, delay), shape (N, n + 2)."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class OnlineSample:
    """Estimates after one row; as in :class:`OnlineEstimate`."""

    t: float
    a: FloatArray
    b: float
    delay_s: float
    state: FloatArray
    covariance: FloatArray


class OnlineEstimator:
    """The estimator as a live rig calls it: one row in, the estimates after it out.

    Parameters
    ----------
    order : int
        Order n.
    forgetting : float
        lambda [1/s]; the kernels of the parameters look back (n+2)/lambda.
    memory_s : float, optional
        Time over which equations are averaged [s]; (4 n + 8)/lambda where neither it nor a gain is given. The gain
        matrix is the averaged equations' inverse over this time: a unit of t, u or y changes nothing.
    gain : float, optional
        The paper's scalar Lambda instead, whose effect depends on the units of u and y.
    delay : DelayTracking, optional
        How the delay is followed; the plant has none where not given.
    linear : bool
        Whether u runs linearly between rows; held otherwise.
    offset : bool
        Whether a constant is estimated, as where u and y are counted from an operating point; not with ``gain``.

    Raises
    ------
    InputError
        Settings that are not positive, or both a gain and an offset.

    Notes
    -----
    Only u's past that the delay may reach is kept: memory is bounded by ``DelayTracking.longest_s``. The covariance is
    that of least squares with forgetting under noise of any colour, what the estimate itself follows of it and the few
    degrees of freedom of its density counted in: 93 to 98 of 100 intervals hold the truth on Example 1 at noise 1 and
    5, white and coloured. It does not hold the bias that noise on y brings into the regressors (a fifth of a standard
    deviation there), nor the lag behind a parameter that moves; what a delay far from its start leaves widens it for
    some memories. Where these matter, fit windows by output error (:mod:`autotune.identification.delay.tracking`).
    """

    def __init__(
        self,
        order: int,
        *,
        forgetting: float,
        memory_s: float | None = None,
        gain: float | None = None,
        delay: DelayTracking | None = None,
        linear: bool = True,
        offset: bool = False,
    ) -> None:
        for name, value in {"order": order, "forgetting": forgetting, "memory_s": memory_s, "gain": gain}.items():
            absent = value is None and name in ("memory_s", "gain")
            if not absent and not (is_real(value) and math.isfinite(value or 0.0)):
                raise InputError(f"{name} = {value!r}"[:200], where="follow", remedy="give a positive number")
        if not isinstance(linear, bool) or not isinstance(offset, bool):
            raise InputError(f"linear = {linear!r}, offset = {offset!r}"[:200], where="follow", remedy="True or False")
        if order != int(order) or order > _MOST_ORDER:
            raise InputError(f"order = {order!r}", where="follow", remedy=f"a whole number, at most {_MOST_ORDER}")
        if not isinstance(delay, DelayTracking | None):
            raise InputError(f"delay = {delay!r}"[:200], where="follow", remedy="give DelayTracking(start_s=...)")
        memory_s = (4.0 * order + 8.0) / forgetting if memory_s is None and forgetting > 0.0 else memory_s
        if not (forgetting > 0 and (gain is None or gain > 0) and (memory_s or 0.0) > 0 and order >= 1):
            raise InputError("forgetting, memory, gain and order must be positive", where="follow")
        if gain is not None and offset:
            raise InputError("a scalar gain has no offset", where="follow", remedy="give memory_s instead")
        order = int(order)
        self._delay = delay
        self._settings = chain.Settings(
            n=order,
            lam=float(forgetting),
            gain=float(gain or 0.0),
            memory_s=float(memory_s or 0.0),
            linear=linear,
            delayed=delay is not None,
            offset=offset,
            after=float(delay.after_s) if delay else np.inf,
            rate=float(delay.rate) if delay else 0.0,
        )
        kernels, unknowns = 2 * order + 2, order + (2 if delay else 1) + int(offset)
        self._carried = chain.Carried(
            Jy=np.zeros(kernels),
            Ju=np.zeros(kernels),
            A=np.zeros(unknowns),
            R=np.zeros((unknowns, unknowns)),
            slow=np.zeros(unknowns),
            spread=np.zeros((unknowns, unknowns)),
            scalars=np.zeros(8),
        )
        self._scalars = self._carried.scalars
        self._scalars[chain.H] = delay.start_s if delay else 0.0
        self._t, self._u, self._past = np.empty(_ROOM), np.empty(_ROOM), np.zeros((_ROOM, kernels))
        self._rows = self._taken = 0
        self._first_t = 0.0

    def step(self, t: float, u: float, y: float) -> OnlineSample:
        """Take a row and return the estimates after it.

        Parameters
        ----------
        t, u, y : float
            Time stamp [s], later than the last one's, command and measurement; u acts from t on.

        Returns
        -------
        OnlineSample

        Raises
        ------
        InputError
            A value that is not a number, or a stamp that is not later.
        IdentificationError
            The delay ran out of the record: lock was lost.
        """
        if not all(is_real(value) and math.isfinite(value) for value in (t, u, y)):
            said = f"t = {t!r}, u = {u!r}, y = {y!r}"[:200]
            raise InputError(said, where="step", remedy="leave out rows that are not numbers")
        if self._rows and not t > self._scalars[chain.LAST_T]:
            raise InputError(f"t = {t:g} s is not later than the last row", where="step", remedy="call it once a row")
        self._make_room()
        k, n = self._rows, self._settings.n
        self._t[k], self._u[k] = t, u
        self._rows += 1
        self._taken += 1
        if self._taken == 1:
            self._begin(t, u, y)
            return self._sample(t, np.full(n, np.nan), np.full(self._carried.R.shape, np.nan))
        state, covariance, locked = chain.step_row(k, self._t, self._u, self._past, y, self._carried, self._settings)
        if not locked:
            raise _refusal_of_rows(t)
        return self._filled_sample(t, state, covariance)

    @check_arguments
    def run(self, t: FloatArray, u: FloatArray, y: FloatArray) -> OnlineSample:
        """Take all rows of a record at once, as the first ones, and return the estimates after the last.

        Parameters
        ----------
        t, u, y : (N,) arrays
            As of :meth:`step`, in order.

        Raises
        ------
        InputError, IdentificationError
            As of :meth:`step`, or columns that are not of one length.
        """
        if not (t.shape == u.shape == y.shape and t.size > 1 and np.all(np.diff(t) > 0.0)):
            what = f"t, u and y of shapes {t.shape}, {u.shape} and {y.shape}"
            raise InputError(what, where="run", remedy="give one of each for every row, two at least, in order")
        self._t, self._u, self._past = t, u, np.zeros((t.size, self._past.shape[1]))
        self._rows = self._taken = t.size
        self._begin(t[0], u[0], y[0])
        state, covariance, lost = chain.step_rows(t, u, self._past, y, self._carried, self._settings)
        if lost:
            raise _refusal_of_rows(float(t[lost]))
        return self._filled_sample(float(t[-1]), state, covariance)

    def _begin(self, t: float, u: float, y: float) -> None:
        self._first_t = float(t)
        for place, value in ((chain.LAST_T, t), (chain.LAST_U, u), (chain.LAST_Y, y), (chain.FIRST_T, t)):
            self._scalars[place] = value

    def _filled_sample(self, t: float, state: FloatArray, covariance: FloatArray) -> OnlineSample:
        """Return the estimates, the state only once the kernels have filled."""
        n = self._settings.n
        age = t - self._first_t
        filled = age > (n + 2) / self._settings.lam + 10.0 * age / (self._taken - 1)
        return self._sample(t, state if filled else np.full(n, np.nan), covariance)

    def _make_room(self) -> None:
        """Forget rows that no delay reaches any more, or make the store larger."""
        k = self._rows
        if k < len(self._t):
            return
        longest = self._delay.longest_s if self._delay else 0.0
        first = int(np.searchsorted(self._t[:k], self._t[k - 1] - longest)) - 1 if np.isfinite(longest) else 0
        first = min(max(first, 0), k - 1)
        room = max(_ROOM, 2 * (k - first))
        for name in ("_t", "_u", "_past"):
            old = getattr(self, name)
            fresh = np.zeros((room, *old.shape[1:]))
            fresh[: k - first] = old[first:k]
            setattr(self, name, fresh)
        self._rows = k - first
        self._scalars[chain.ROW] = max(self._scalars[chain.ROW] - first, 0)

    def _delay_s(self, t: float) -> float:
        """Return the delay: the followed one, or what is lacking below zero, where u is not known yet."""
        h, n, A = float(self._scalars[chain.H]), self._settings.n, self._carried.A
        followed = self._delay is not None and t - self._first_t > self._delay.after_s and A[n] != 0.0
        return h if h > 0.0 or not followed else min(float(A[n + 1] / A[n]), 0.0)

    def _sample(self, t: float, state: FloatArray, covariance: FloatArray) -> OnlineSample:
        n, A, memory_s = self._settings.n, self._carried.A, self._settings.memory_s
        jacobian = np.zeros((n + 2, A.size))
        jacobian[: n + 1, : n + 1] = np.eye(n + 1)
        if self._delay:  # h_hat follows h_hat + b_1 / b_0, whose noise is as slow as the memory, with its rate
            follows = self._delay.rate / (self._delay.rate + 1.0 / memory_s) if memory_s else 1.0
            jacobian[n + 1, n + 1] = np.sqrt(follows) / A[n] if A[n] != 0.0 else np.nan
        if self._settings.gain:
            covariance = np.full_like(covariance, np.nan)
        return OnlineSample(
            t=float(t),
            a=A[:n].copy(),
            b=float(A[n]),
            delay_s=self._delay_s(t),
            state=state,
            covariance=jacobian @ covariance @ jacobian.T,
        )


def _refusal_of_rows(t: float) -> IdentificationError:
    return IdentificationError(
        f"the delay estimate left the record at t = {t:g} s: lock was lost",
        remedy="start nearer to the delay, later, or with a lower rate; identify_delay finds a start",
    )


def follow(
    recording: Recording,
    order: int,
    *,
    forgetting: float,
    memory_s: float | None = None,
    gain: float | None = None,
    delay: DelayTracking | None = None,
    linear: bool = True,
) -> OnlineEstimate:
    """Follow the parameters, the state and, where asked for, the delay over a recording, row by row.

    Parameters
    ----------
    recording : Recording
        Rows of t, u, y.
    order, forgetting, memory_s, gain, delay, linear
        As of :class:`OnlineEstimator`, whose steps these are.

    Returns
    -------
    OnlineEstimate
        Every row uses rows up to itself only.

    Raises
    ------
    InputError
        Bad values in the rows, or settings that are not positive.
    IdentificationError
        The delay ran out of the record: lock was lost.

    References
    ----------
    Section 2, Example 1; section 4, Examples 4 and 5.
    """
    recording.require_finite()
    estimator = OnlineEstimator(order, forgetting=forgetting, memory_s=memory_s, gain=gain, delay=delay, linear=linear)
    rows = zip(recording.t.tolist(), recording.u.tolist(), recording.y.tolist(), strict=True)
    samples = [estimator.step(t, u, y) for t, u, y in rows]
    return OnlineEstimate(
        t=recording.t,
        a=np.array([sample.a for sample in samples]),
        b=np.array([sample.b for sample in samples]),
        delay_s=np.array([sample.delay_s for sample in samples]),
        state=np.array([sample.state for sample in samples]),
        covariance=np.array([sample.covariance for sample in samples]),
    )
