"""What every simulated plant offers, and how one is made by name."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


@runtime_checkable
class Plant(Protocol):
    """A plant that lives in its own time: a held command drives it, a measurement looks at it.

    ``response`` and ``u_rest`` are the truth that a tool has to find; only tests and benchmarks may look at them.
    """

    @property
    def time_s(self) -> float:
        """Time the plant has lived [s]."""
        ...

    @property
    def u_applied(self) -> float:
        """Command the actuator really holds, after converter and saturation [u unit]."""
        ...

    @property
    def u_rest(self) -> float:
        """Truth: command at which the plant rests at its operating point [u unit]."""
        ...

    @property
    def y_true(self) -> float:
        """Truth: the sensor's signal before noise and converter [y unit]."""
        ...

    def advance(self, u: float, dt_s: float) -> None:
        """Hold a command.

        Parameters
        ----------
        u : float
            Command that is held [u unit].
        dt_s : float
            How long [s].
        """
        ...

    def measure(self) -> float:
        """Return one measurement [y unit]; every call draws new noise."""
        ...

    def response(self, omega_rad_s: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Truth: small-signal complex gain from held command to sensor signal, same shape as ``omega_rad_s``."""
        ...


def make_plant(
    name: str, *, seed: int = 0, noise: float | None = None, start: str | None = None, converters: bool = True
) -> Plant:
    """Return the named plant.

    Parameters
    ----------
    name : {"ball", "servo", "two_tank", "thermal"}
        Which plant.
    seed : int
        Draws what the tool cannot know (such as the hover voltage) and the noise.
    noise : float, optional
        Half-width of the uniform measurement noise [y unit]; the plant's own where absent.
    start : str, optional
        Where the plant starts, in the plant's own words (the ball: ``floor`` or ``afloat``); usually at rest, idle.
    converters : bool
        Whether the ball comes with its own converters; a device in front of it has others.

    Raises
    ------
    ValueError
        No such plant, or a start it does not know.
    """
    # imported here so that a plant pays for no other plant's compilation
    match name:
        case "ball":
            from sim.ball import make_ball

            return make_ball(seed=seed, noise=noise, start=start, converters=converters)
        case "servo":
            from sim.servo import make_servo

            return make_servo(seed=seed, noise=noise, start=start)
        case "two_tank":
            from sim.tank import make_two_tank

            return make_two_tank(seed=seed, noise=noise, start=start)
        case "thermal":
            from sim.tank import make_heater

            return make_heater(seed=seed, noise=noise, start=start)
    raise ValueError(f"no simulated plant {name!r}")
