"""The ball levitated in a tube: turbine, ball speed, height, sonar, with the tube's ends and the converters.

Around its operating point the chain is exactly equation (23) of Le & Mendes 2010,

    H(s) = -65.5 / (2.02e-5 s^4 + 0.007328 s^3 + 0.3836 s^2 + s),

whose denominator factors into an integrator (height) and three lags: ball speed 0.3636 s, turbine 16.67 ms, sonar
3.333 ms. The sonar looks down from the top, so the floor is the high end of y and the gain is negative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

GAIN = -65.5
DENOMINATOR = (2.02e-5, 0.007328, 0.3836, 1.0, 0.0)
#: time constants [s] of ball speed, turbine, sonar: the factors of (23), so that the chain is (23) to the last digit
TAU_BALL, TAU_TURBINE, TAU_SONAR = sorted((-1.0 / np.roots(DENOMINATOR[:4]).real).tolist(), reverse=True)
U_NOMINAL = 5.0
Y_NOMINAL = 5.0
CEILING, FLOOR = 0.0, 10.0
FULL_SCALE = 10.0
#: the tube's ends are looked for at steps no longer than this; a graze between two looks is shorter than 20 um of tube
LOOK_S = 0.005


@dataclass(frozen=True, kw_only=True)
class BallSettings:
    """What distinguishes one ball rig from another.

    Attributes
    ----------
    hover : float
        Command at which the ball hovers [V].
    noise : float
        Half-width of the uniform sonar noise [V].
    bits : int or None
        Resolution of both converters over 0..10 V; None for neither converter nor saturation.
    ends : bool
        Whether the tube has its floor (10 V) and ceiling (0 V); both stop the ball without a bounce.
    start : float
        Height the ball starts at, at rest [V].
    """

    hover: float = U_NOMINAL
    noise: float = 0.35
    bits: int | None = 12
    ends: bool = True
    start: float = FLOOR


def make_ball(*, seed: int = 0, noise: float | None = None, start: str | None = None, converters: bool = True) -> Ball:
    """Return a ball rig whose hover voltage is drawn uniformly within 0.5 V of the nominal 5 V.

    Parameters
    ----------
    seed : int
        Draws hover voltage and noise.
    noise : float, optional
        Half-width of the uniform noise [V]; 0.35 where absent.
    start : {"floor", "afloat"}, optional
        Where the ball starts; on the floor where absent.
    converters : bool
        Whether it comes with its 12-bit converters; a device in front of it has its own.
    """
    heights = {None: FLOOR, "floor": FLOOR, "afloat": Y_NOMINAL}
    if start not in heights:
        raise ValueError(f"a ball starts on the floor or afloat, not {start!r}")
    hover = U_NOMINAL + float(np.random.default_rng((seed, 1)).uniform(-0.5, 0.5))
    settings = BallSettings(
        hover=hover, noise=0.35 if noise is None else noise, bits=12 if converters else None, start=heights[start]
    )
    return Ball(settings, seed=seed)


def linear_ball(*, hover: float = U_NOMINAL, noise: float = 0.0, seed: int = 0) -> Ball:
    """Return the ball without ends, converters and saturation, starting afloat: (23) and nothing else.

    Parameters
    ----------
    hover : float
        Command that holds it afloat [V].
    noise : float
        Half-width of the uniform noise [V].
    seed : int
        Of the noise.
    """
    return Ball(BallSettings(hover=hover, noise=noise, bits=None, ends=False, start=Y_NOMINAL), seed=seed)


class Ball:
    """The ball rig; see :class:`BallSettings` and :class:`sim.plant.Plant`."""

    def __init__(self, settings: BallSettings, *, seed: int = 0) -> None:
        self.settings = settings
        # the turbine idles at 0 V on the floor, and blows the hover voltage where the ball starts afloat
        grounded = settings.ends and settings.start == FLOOR
        flow = -settings.hover if grounded else 0.0
        self._x = np.array([flow, 0.0, settings.start, settings.start])
        self.u_applied = 0.0 if grounded else settings.hover
        self.time_s = 0.0
        self._random = np.random.default_rng((seed, 2))
        self._noise: list[float] = []

    @property
    def u_rest(self) -> float:
        """Truth: hover voltage [V]."""
        return self.settings.hover

    @property
    def height(self) -> float:
        """Truth: where the ball is, in the sonar's volts [V]."""
        return float(self._x[2])

    @property
    def y_true(self) -> float:
        """Truth: the sonar's signal before noise and converter [V]."""
        return float(self._x[3])

    def advance(self, u: float, dt_s: float) -> None:
        """Hold a command: exact integration, with the tube's ends found to 1 ns.

        Parameters
        ----------
        u : float
            Command that is held [V].
        dt_s : float
            How long [s].
        """
        self.u_applied = self._convert(u)
        _advance(self._x, self.u_applied - self.settings.hover, dt_s, self.settings.ends)
        self.time_s += dt_s

    def measure(self) -> float:
        """Return one sonar reading [V]."""
        if not self._noise:
            half = self.settings.noise or 0.0  # of -0.0 as well, whose range numpy calls negative
            self._noise = self._random.uniform(-half, half, 4096).tolist()
        return self._convert(float(self._x[3]) + self._noise.pop())

    def response(self, omega_rad_s: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Truth: H(j omega) of (23)."""
        return np.asarray(GAIN / np.polyval(DENOMINATOR, 1j * np.asarray(omega_rad_s)), dtype=np.complex128)

    def _convert(self, volts: float) -> float:
        bits = self.settings.bits
        if bits is None:
            return volts
        step = FULL_SCALE / 2**bits
        return float(min(max(round(volts / step), 0), 2**bits - 1) * step)


@njit(cache=True)
def _fly(x: NDArray[np.float64], u: float, t: float, out: NDArray[np.float64]) -> None:
    """Free flight for ``t`` [s] under a constant ``u`` relative to hover [V]: the lags' closed solution."""
    e1, e2, e3 = np.exp(-t / TAU_TURBINE), np.exp(-t / TAU_BALL), np.exp(-t / TAU_SONAR)
    slope = GAIN * u
    a = GAIN * (x[0] - u) / (1.0 - TAU_BALL / TAU_TURBINE)
    b = x[1] - slope - a
    level = x[2] + a * TAU_TURBINE + b * TAU_BALL
    out[0] = u + (x[0] - u) * e1
    out[1] = slope + a * e1 + b * e2
    out[2] = level + slope * t - a * TAU_TURBINE * e1 - b * TAU_BALL * e2
    from_turbine = -a * TAU_TURBINE / (1.0 - TAU_SONAR / TAU_TURBINE)
    from_ball = -b * TAU_BALL / (1.0 - TAU_SONAR / TAU_BALL)
    lagged = level - slope * TAU_SONAR
    c = x[3] - lagged - from_turbine - from_ball
    out[3] = lagged + slope * t + from_turbine * e1 + from_ball * e2 + c * e3


@njit(cache=True)
def _rest(x: NDArray[np.float64], u: float, t: float) -> None:
    """Lie at an end for ``t`` [s]: only turbine and sonar move."""
    x[0] = u + (x[0] - u) * np.exp(-t / TAU_TURBINE)
    x[1] = 0.0
    x[3] = x[2] + (x[3] - x[2]) * np.exp(-t / TAU_SONAR)


@njit(cache=True)
def _copy(new: NDArray[np.float64], x: NDArray[np.float64]) -> None:
    for i in range(4):  # entry by entry: an assigned slice is compiled with the text of its error, for seconds
        x[i] = new[i]


@njit(cache=True)
def _advance(x: NDArray[np.float64], u: float, dt_s: float, ends: bool) -> None:
    """Advance the state in place through flights, landings and lift-offs."""
    left = dt_s
    new = np.empty(4)
    while left > 0.0:
        side = 0.0 if not ends else 1.0 if x[2] >= FLOOR else -1.0 if x[2] <= CEILING else 0.0
        if side != 0.0 and x[1] == 0.0 and side * x[0] <= 0.0:
            # lift-off when the flow crosses hover: u + (x0 - u) exp(-t / tau) = 0
            wait = min(left, TAU_TURBINE * np.log((u - x[0]) / u)) if side * u > 0.0 else left
            _rest(x, u, wait)
            left -= wait
            if left > 0.0:
                x[0] = 0.0
                step = min(left, LOOK_S)
                _fly(x, u, step, new)
                _copy(new, x)
                x[2] = min(max(x[2], CEILING), FLOOR)  # rounding only
                left -= step
            continue
        step = min(left, LOOK_S) if ends else left
        _fly(x, u, step, new)
        if ends and (new[2] > FLOOR or new[2] < CEILING):
            end = FLOOR if new[2] > FLOOR else CEILING
            early, late = 0.0, step
            while late - early > 1e-9:
                middle = 0.5 * (early + late)
                _fly(x, u, middle, new)
                if new[2] > FLOOR or new[2] < CEILING:
                    late = middle
                else:
                    early = middle
            _fly(x, u, late, new)
            new[1], new[2] = 0.0, end
            step = late
        _copy(new, x)
        left -= step
