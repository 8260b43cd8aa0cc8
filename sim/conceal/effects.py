"""What can be concealed: each effect, where it makes sense, and what counts as naming it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sim.conceal import sizes
from sim.conceal.sizes import Maker, Sized

BALL, SERVO, PROCESS = "ball_in_tube", "servo", "process"
LOOPS = (BALL, SERVO)
ALL = (BALL, SERVO, PROCESS)


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One entry of the generator's list."""

    name: str
    rigs: tuple[str, ...]
    make: Maker
    accept: tuple[str, ...] = ()
    places: tuple[str, ...] = ()
    forecastable: bool = True
    open_loop_only: bool = False
    variant: str = ""  # only on this kind of process

    @property
    def outside(self) -> bool:
        """Whether no catalogue has it."""
        return self.name.startswith("x.")

    def answer(self, sized: Sized, rig: str) -> dict[str, Any]:
        """Entry of ``effects`` in the answer file.

        Parameters
        ----------
        sized : Sized
            The effect at its size.
        rig : str
            Family of the rig.
        """
        accept = [] if self.outside else sorted({self.name, *self.accept})
        if rig != PROCESS and self.name != "sensor.drift":  # a drifting sensor looks like a drifting load on a lag only
            accept = [name for name in accept if name != "sensor.drift"]
        values = {key: {"value": value, "unit": unit} for key, (value, unit) in sized.parameters.items()}
        return {"name": self.name, "accept": accept, "parameters": values}


_LAG = ("actuator.lag", "sensor.lag")
_LOAD_PLACES = ("environment", "actuator", "plant")

EFFECTS = (
    Effect(name="actuator.saturation", rigs=ALL, make=sizes.saturation),
    Effect(name="actuator.dead_zone", rigs=ALL, make=sizes.dead_zone),
    Effect(name="actuator.rate_limit", rigs=ALL, make=sizes.rate_limit),
    Effect(name="actuator.backlash", rigs=ALL, make=sizes.backlash),
    Effect(name="actuator.stiction", rigs=ALL, make=sizes.stiction),
    Effect(name="actuator.lag", rigs=ALL, make=sizes.actuator_lag, accept=_LAG, places=("sensor", "plant")),
    Effect(name="actuator.asymmetric_lag", rigs=(BALL, PROCESS), make=sizes.asymmetric_lag),
    Effect(name="actuator.nonlinear_gain", rigs=ALL, make=sizes.actuator_gain),
    Effect(name="actuator.gain_drift", rigs=ALL, make=sizes.gain_drift, places=("plant",)),
    Effect(name="actuator.quantisation", rigs=ALL, make=sizes.command_quantum),
    Effect(
        name="actuator.offset", rigs=LOOPS, make=sizes.offset, accept=("environment.step_load",), places=_LOAD_PLACES
    ),
    Effect(name="plant.coulomb_friction", rigs=(SERVO,), make=sizes.coulomb),
    Effect(name="plant.stribeck_friction", rigs=(SERVO,), make=sizes.stribeck),
    Effect(name="plant.quadratic_drag", rigs=LOOPS, make=sizes.drag),
    Effect(name="plant.cubic_stiffness", rigs=(SERVO,), make=sizes.cubic),
    Effect(name="plant.position_dependent_gain", rigs=LOOPS, make=sizes.position_gain),
    Effect(name="plant.hard_stop", rigs=ALL, make=sizes.hard_stop),
    Effect(name="plant.sqrt_outflow", rigs=(PROCESS,), make=sizes.sqrt_outflow, variant="level"),
    Effect(name="plant.radiation_loss", rigs=(PROCESS,), make=sizes.radiation, variant="thermal"),
    Effect(name="plant.resonance", rigs=LOOPS, make=sizes.resonance, places=("actuator", "sensor")),
    Effect(name="plant.hysteresis", rigs=(SERVO,), make=sizes.hysteresis),
    Effect(name="plant.leak", rigs=LOOPS, make=sizes.leak),
    Effect(name="plant.sine_torque", rigs=(SERVO,), make=sizes.sine_torque),
    Effect(name="sensor.saturation", rigs=ALL, make=sizes.sensor_high),
    Effect(name="sensor.lag", rigs=ALL, make=sizes.sensor_lag, accept=_LAG, places=("actuator", "plant")),
    Effect(name="sensor.quantisation", rigs=ALL, make=sizes.sensor_quantum),
    Effect(name="sensor.nonlinear_gain", rigs=ALL, make=sizes.sensor_gain),
    Effect(name="sensor.absolute_value", rigs=(PROCESS,), make=sizes.fold, open_loop_only=True),
    Effect(
        name="sensor.drift",
        rigs=(PROCESS,),
        make=sizes.sensor_drift,
        accept=("environment.drifting_load",),
        places=_LOAD_PLACES,
    ),
    Effect(name="sensor.dropout", rigs=ALL, make=sizes.dropout, forecastable=False),
    Effect(name="sensor.outliers", rigs=ALL, make=sizes.outliers, forecastable=False),
    Effect(name="timing.dead_time", rigs=LOOPS, make=sizes.dead_time, places=("actuator", "sensor", "plant")),
    Effect(name="timing.jitter", rigs=ALL, make=sizes.jitter, forecastable=False),
    Effect(name="timing.clock_error", rigs=ALL, make=sizes.clock),
    Effect(name="environment.step_load", rigs=ALL, make=sizes.load_step, places=_LOAD_PLACES, forecastable=False),
    Effect(name="environment.periodic_load", rigs=ALL, make=sizes.periodic_load, places=_LOAD_PLACES),
    Effect(
        name="environment.drifting_load",
        rigs=ALL,
        make=sizes.drifting_load,
        accept=("sensor.drift",),
        places=(*_LOAD_PLACES, "sensor"),
    ),
    Effect(name="controller.law", rigs=ALL, make=sizes.law, forecastable=False),
    Effect(name="x.echo", rigs=ALL, make=sizes.echo, places=("sensor",)),
    Effect(name="x.gain_switching", rigs=ALL, make=sizes.switching, places=("actuator", "plant")),
    Effect(name="x.modulated_lag", rigs=ALL, make=sizes.modulate("modulated_lag", 0.9), places=("plant",)),
    Effect(
        name="x.modulated_delay",
        rigs=ALL,
        make=sizes.modulate("modulated_delay", 0.8),
        places=("timing", "actuator", "sensor"),
    ),
    Effect(
        name="x.parametric_stiffness",
        rigs=LOOPS,
        make=sizes.modulate("modulated_stiffness", 9.0),
        places=("plant", "environment"),
    ),
    Effect(name="x.crosstalk", rigs=ALL, make=sizes.crosstalk, places=("sensor",)),
    Effect(name="x.creep", rigs=(PROCESS,), make=sizes.creep, places=("plant", "sensor")),
    Effect(name="x.chirp_load", rigs=ALL, make=sizes.chirp, places=_LOAD_PLACES),
)
BY_NAME = {effect.name: effect for effect in EFFECTS}
