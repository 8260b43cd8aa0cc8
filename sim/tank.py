"""Slow self-regulating plants: two tanks in cascade, and a heater block; both nonlinear, both with lags in series.

Two tanks (areas A, outlets a, levels h1 above h2, pump flow k v; the pump lags, the level sensor lags)::

    A h1' = k v        - a sqrt(2 g h1)
    A h2' = a sqrt(2 g h1) - a sqrt(2 g h2)

Heater block (block T, sensor Ts; heat loss by convection and by radiation)::

    C T'  = P v / 100 - U (T - Ta) - eps sigma S (T^4 - Ta^4)       temperatures in K
    tau Ts' = T - Ts
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

_G = 981.0  # cm/s^2
_STEFAN_BOLTZMANN = 5.670374419e-8  # W/(m^2 K^4)
_ZERO_C = 273.15
_U_MAX = {"tanks": 10.0, "heater": 100.0}


@dataclass(frozen=True, kw_only=True)
class TwoTankSettings:
    """Two equal tanks with a pump; sizes as in a laboratory rig.

    Attributes
    ----------
    area, outlet : float
        Cross-sections of tank and outlet [cm^2].
    pump : float
        Flow per voltage [cm^3/s/V].
    tau_pump, tau_sensor : float
        Time constants of pump and level sensor [s].
    height : float
        Height of the tanks; beyond it they run over [cm].
    level : float
        Operating point of the lower tank, where :attr:`TwoTank.u_rest` holds it [cm].
    noise : float
        Half-width of the uniform noise [cm].
    start : float
        Levels of both tanks at the start, at rest under the voltage that holds them [cm].
    """

    area: float = 28.0
    outlet: float = 0.071
    pump: float = 3.33
    tau_pump: float = 1.0
    tau_sensor: float = 2.0
    height: float = 20.0
    level: float = 10.0
    noise: float = 0.05
    start: float = 0.0


@dataclass(frozen=True, kw_only=True)
class HeaterSettings:
    """A heated block of metal with a sensor.

    Attributes
    ----------
    capacity : float
        Heat capacity [J/K].
    power : float
        Heater power at 100 % [W].
    loss : float
        Convective loss [W/K].
    surface, emissivity : float
        Radiating surface [m^2] and its emissivity.
    tau_sensor, tau_element : float
        Time constants of sensor and heating element [s].
    ambient : float
        Ambient temperature [degC].
    target : float
        Operating point, where :attr:`Heater.u_rest` holds it [degC].
    noise : float
        Half-width of the uniform noise [degC].
    """

    capacity: float = 40.0
    power: float = 10.0
    loss: float = 0.06
    surface: float = 0.0012
    emissivity: float = 0.9
    tau_sensor: float = 15.0
    tau_element: float = 3.0
    ambient: float = 22.0
    target: float = 50.0
    noise: float = 0.1


def make_two_tank(*, seed: int = 0, noise: float | None = None, start: str | None = None) -> TwoTank:
    """Return two tanks whose pump gain is drawn uniformly within 10 % of nominal.

    Parameters
    ----------
    seed : int
        Draws pump gain and noise.
    noise : float, optional
        Half-width of the uniform noise [cm]; 0.05 where absent.
    start : {"empty", "level"}, optional
        Empty with the pump off, or at rest at the operating point; empty where absent.
    """
    nominal = TwoTankSettings()
    starts = {None: 0.0, "empty": 0.0, "level": nominal.level}
    if start not in starts:
        raise ValueError(f"the tanks start empty or at level, not {start!r}")
    factor = 1.0 + float(np.random.default_rng((seed, 1)).uniform(-0.1, 0.1))
    settings = TwoTankSettings(
        pump=nominal.pump * factor, noise=nominal.noise if noise is None else noise, start=starts[start]
    )
    return TwoTank(settings, seed=seed)


def make_heater(*, seed: int = 0, noise: float | None = None, start: str | None = None) -> Heater:
    """Return a heater block whose ambient temperature is drawn uniformly within 2 degC of 22 degC.

    Parameters
    ----------
    seed : int
        Draws ambient temperature and noise.
    noise : float, optional
        Half-width of the uniform noise [degC]; 0.1 where absent.
    start : {"cold", "warm"}, optional
        At ambient temperature, or at rest at the operating point; cold where absent.
    """
    if start not in (None, "cold", "warm"):
        raise ValueError(f"the block starts cold or warm, not {start!r}")
    ambient = 22.0 + float(np.random.default_rng((seed, 1)).uniform(-2.0, 2.0))
    settings = HeaterSettings(ambient=ambient, noise=HeaterSettings.noise if noise is None else noise)
    return Heater(settings, seed=seed, warm=start == "warm")


class TwoTank:
    """The two tanks; see :class:`TwoTankSettings` and :class:`sim.plant.Plant`."""

    def __init__(self, settings: TwoTankSettings, *, seed: int = 0) -> None:
        self.settings = settings
        rest = self._holding(settings.start)
        self._x = np.array([rest, settings.start, settings.start, settings.start])
        self.u_applied = rest
        self.time_s = 0.0
        self._random = np.random.default_rng((seed, 2))

    @property
    def u_rest(self) -> float:
        """Truth: voltage that holds the lower tank at its operating point [V]."""
        return self._holding(self.settings.level)

    @property
    def y_true(self) -> float:
        """Truth: lagged level of the lower tank before noise [cm]."""
        return float(self._x[3])

    def advance(self, u: float, dt_s: float) -> None:
        """Hold a command; fourth-order steps of at most 0.1 s.

        Parameters
        ----------
        u : float
            Command that is held [V].
        dt_s : float
            How long [s].
        """
        self.u_applied = min(max(u, 0.0), _U_MAX["tanks"])
        p = self.settings
        constants = np.array([p.area, p.outlet, p.pump, p.tau_pump, p.tau_sensor, p.height])
        _fill(self._x, self.u_applied, dt_s, constants)
        self.time_s += dt_s

    def measure(self) -> float:
        """Return one level reading [cm]."""
        half = self.settings.noise
        return self.y_true + (float(self._random.uniform(-half, half)) if half else 0.0)

    def response(self, omega_rad_s: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Truth: small-signal complex gain at the operating point."""
        p = self.settings
        s = 1j * np.asarray(omega_rad_s)
        T = p.area / p.outlet * math.sqrt(2.0 * p.level / _G)
        lags = (p.tau_pump * s + 1) * (T * s + 1) ** 2 * (p.tau_sensor * s + 1)
        return np.asarray(p.pump * T / p.area / lags, dtype=np.complex128)

    def _holding(self, level: float) -> float:
        return self.settings.outlet * math.sqrt(2.0 * _G * level) / self.settings.pump


class Heater:
    """The heater block; see :class:`HeaterSettings` and :class:`sim.plant.Plant`."""

    def __init__(self, settings: HeaterSettings, *, seed: int = 0, warm: bool = False) -> None:
        self.settings = settings
        T = settings.target if warm else settings.ambient
        self.u_applied = self._holding(T)
        self._x = np.array([self.u_applied, T + _ZERO_C, T + _ZERO_C])
        self.time_s = 0.0
        self._random = np.random.default_rng((seed, 2))

    @property
    def u_rest(self) -> float:
        """Truth: power that holds the operating point [%]."""
        return self._holding(self.settings.target)

    @property
    def y_true(self) -> float:
        """Truth: the sensor's temperature before noise [degC]."""
        return float(self._x[2]) - _ZERO_C

    def advance(self, u: float, dt_s: float) -> None:
        """Hold a command; fourth-order steps of at most 0.25 s.

        Parameters
        ----------
        u : float
            Command that is held [%].
        dt_s : float
            How long [s].
        """
        self.u_applied = min(max(u, 0.0), _U_MAX["heater"])
        p = self.settings
        radiation = p.emissivity * _STEFAN_BOLTZMANN * p.surface
        constants = np.array([p.capacity, p.power, p.loss, radiation, p.tau_sensor, p.tau_element, p.ambient + _ZERO_C])
        _heat(self._x, self.u_applied, dt_s, constants)
        self.time_s += dt_s

    def measure(self) -> float:
        """Return one temperature reading [degC]."""
        half = self.settings.noise
        return self.y_true + (float(self._random.uniform(-half, half)) if half else 0.0)

    def response(self, omega_rad_s: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Truth: small-signal complex gain at the operating point."""
        p = self.settings
        s = 1j * np.asarray(omega_rad_s)
        T = p.target + _ZERO_C
        loss = p.loss + 4.0 * p.emissivity * _STEFAN_BOLTZMANN * p.surface * T**3
        lags = (p.tau_element * s + 1) * (p.capacity / loss * s + 1) * (p.tau_sensor * s + 1)
        return np.asarray(p.power / 100.0 / loss / lags, dtype=np.complex128)

    def _holding(self, celsius: float) -> float:
        p = self.settings
        T, Ta = celsius + _ZERO_C, p.ambient + _ZERO_C
        watts = p.loss * (T - Ta) + p.emissivity * _STEFAN_BOLTZMANN * p.surface * (T**4 - Ta**4)
        return 100.0 * watts / p.power


@njit(cache=True)
def _tank_rates(x: NDArray[np.float64], u: float, c: NDArray[np.float64]) -> NDArray[np.float64]:
    area, outlet, pump, tau_pump, tau_sensor, _ = c
    upper = outlet * np.sqrt(2.0 * _G * max(x[1], 0.0))
    lower = outlet * np.sqrt(2.0 * _G * max(x[2], 0.0))
    return np.array(
        [(u - x[0]) / tau_pump, (pump * x[0] - upper) / area, (upper - lower) / area, (x[2] - x[3]) / tau_sensor]
    )


@njit(cache=True)
def _fill(x: NDArray[np.float64], u: float, dt_s: float, c: NDArray[np.float64]) -> None:
    """Advance the tanks in place (Runge-Kutta 4)."""
    steps = int(np.ceil(dt_s / 0.1))
    h = dt_s / steps if steps else 0.0
    for _ in range(steps):
        k1 = _tank_rates(x, u, c)
        k2 = _tank_rates(x + 0.5 * h * k1, u, c)
        k3 = _tank_rates(x + 0.5 * h * k2, u, c)
        k4 = _tank_rates(x + h * k3, u, c)
        x += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        for i in (1, 2):
            x[i] = min(max(x[i], 0.0), c[5])  # a tank runs dry, or over


@njit(cache=True)
def _heat_rates(x: NDArray[np.float64], u: float, c: NDArray[np.float64]) -> NDArray[np.float64]:
    capacity, power, loss, radiation, tau_sensor, tau_element, ambient = c
    lost = loss * (x[1] - ambient) + radiation * (x[1] ** 4 - ambient**4)
    return np.array([(u - x[0]) / tau_element, (power * x[0] / 100.0 - lost) / capacity, (x[1] - x[2]) / tau_sensor])


@njit(cache=True)
def _heat(x: NDArray[np.float64], u: float, dt_s: float, c: NDArray[np.float64]) -> None:
    """Advance the block in place (Runge-Kutta 4)."""
    steps = int(np.ceil(dt_s / 0.25))
    h = dt_s / steps if steps else 0.0
    for _ in range(steps):
        k1 = _heat_rates(x, u, c)
        k2 = _heat_rates(x + 0.5 * h * k1, u, c)
        k3 = _heat_rates(x + 0.5 * h * k2, u, c)
        k4 = _heat_rates(x + h * k3, u, c)
        x += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
