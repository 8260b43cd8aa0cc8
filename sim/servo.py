"""A position servo: voltage to speed through armature and inertia, position, encoder filter.

    G(s) = K / (s (tau_m s + 1) (tau_e s + 1) (tau_f s + 1))

integrating, positive gain. A constant load torque on the shaft acts like a voltage that the tool does not know.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class ServoSettings:
    """What distinguishes one servo from another.

    Attributes
    ----------
    gain : float
        Speed per voltage [rad/s/V].
    tau_mechanical, tau_electrical, tau_filter : float
        Time constants of inertia, armature and encoder filter [s].
    load : float
        Voltage that holds the shaft against the load torque [V].
    u_max : float
        The amplifier saturates at this voltage of either sign [V].
    noise : float
        Half-width of the uniform noise of the position [rad].
    resolution : float
        Encoder step [rad]; 0 for none.
    start : float
        Position at the start, at rest [rad].
    """

    gain: float = 2.0
    tau_mechanical: float = 0.08
    tau_electrical: float = 0.005
    tau_filter: float = 0.002
    load: float = 0.0
    u_max: float = 10.0
    noise: float = 0.002
    resolution: float = 2.0 * math.pi / 8192
    start: float = 0.0


def make_servo(*, seed: int = 0, noise: float | None = None, start: str | None = None) -> Servo:
    """Return a servo whose load is drawn uniformly within 0.3 V of none.

    Parameters
    ----------
    seed : int
        Draws load and noise.
    noise : float, optional
        Half-width of the uniform noise [rad]; 0.002 where absent.
    start : {"rest"}, optional
        A servo starts at rest at 0 rad, its load held.
    """
    if start not in (None, "rest"):
        raise ValueError(f"a servo starts at rest, not {start!r}")
    load = float(np.random.default_rng((seed, 1)).uniform(-0.3, 0.3))
    settings = ServoSettings(load=load, noise=ServoSettings.noise if noise is None else noise)
    return Servo(settings, seed=seed)


class Servo:
    """The servo; see :class:`ServoSettings` and :class:`sim.plant.Plant`.

    The partial fractions of G are integrated one by one, each exactly under the held voltage.
    """

    def __init__(self, settings: ServoSettings, *, seed: int = 0) -> None:
        self.settings = settings
        taus = (settings.tau_mechanical, settings.tau_electrical, settings.tau_filter)
        # step response: gain t + sum of r_i (1 - exp(p_i t)), p_i = -1/tau_i
        self._rates = tuple(-1.0 / tau for tau in taus)
        self._residues = tuple(
            -settings.gain * tau * math.prod(tau / (tau - other) for other in taus if other != tau) for tau in taus
        )
        self._turned = settings.start
        self._lags = [0.0, 0.0, 0.0]
        self.u_applied = settings.load
        self.time_s = 0.0
        self._random = np.random.default_rng((seed, 2))

    @property
    def u_rest(self) -> float:
        """Truth: voltage that holds the load [V]."""
        return self.settings.load

    @property
    def y_true(self) -> float:
        """Truth: filtered position before noise and encoder [rad]."""
        return self._turned + sum(self._lags)

    def advance(self, u: float, dt_s: float) -> None:
        """Hold a command.

        Parameters
        ----------
        u : float
            Command that is held [V].
        dt_s : float
            How long [s].
        """
        limit = self.settings.u_max
        self.u_applied = min(max(u, -limit), limit)
        net = self.u_applied - self.settings.load
        self._turned += self.settings.gain * net * dt_s
        for i, (rate, residue) in enumerate(zip(self._rates, self._residues, strict=True)):
            decay = math.exp(rate * dt_s)
            self._lags[i] = decay * self._lags[i] + residue * net * (1.0 - decay)
        self.time_s += dt_s

    def measure(self) -> float:
        """Return one encoder reading [rad]."""
        half, step = self.settings.noise, self.settings.resolution
        y = self.y_true + (float(self._random.uniform(-half, half)) if half else 0.0)
        return round(y / step) * step if step else y

    def response(self, omega_rad_s: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Truth: G(j omega), below saturation."""
        s = 1j * np.asarray(omega_rad_s)
        settings = self.settings
        lags = (settings.tau_mechanical * s + 1) * (settings.tau_electrical * s + 1) * (settings.tau_filter * s + 1)
        return np.asarray(settings.gain / (s * lags), dtype=np.complex128)
