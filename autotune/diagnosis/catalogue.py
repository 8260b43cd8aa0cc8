"""Catalogue of effects: what may be missing in a chain, its equation, its parameters, where it sits, what mimics it.

An entry says how its parameters enter the compiled simulation (a slot of :mod:`autotune.diagnosis.kernel`, or a block
put into the chain), at which structures it makes sense, and from which values a fit starts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from autotune.diagnosis import kernel as k

Scale: TypeAlias = Literal["positive", "real"]
Needs: TypeAlias = Literal["any", "mechanical", "rate", "level", "first_order", "actuator_lag", "integrating"]


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A parameter of an effect.

    Attributes
    ----------
    name : str
        Its name in files.
    unit : str
        Unit, with ``{u}``, ``{f}``, ``{v}``, ``{y}`` for the command's, the plant input's, the speed's and the
        measurement's.
    scale : {"positive", "real"}
        Whether it is searched on a logarithmic or a linear scale.
    slot : int
        Slot in the compiled simulation, -1 where the parameter changes the chain itself.
    """

    name: str
    unit: str
    scale: Scale = "positive"
    slot: int = -1


@dataclass(frozen=True, kw_only=True)
class Range:
    """Sizes of the signals in the recordings, from which starting values follow.

    Attributes
    ----------
    w, f, v, x, y : float
        Largest deviation of command, plant input, speed, position (or level) and reading from the operating point.
    w_low, w_high, y_low, y_high, x_offset : float
        Extremes of command and reading, and the reading at the operating point.
    gain : float
        From plant input to speed or level.
    lag_s, dt_s, duration_s : float
        Dominant time constant, sample time, and length of the longest recording.
    """

    w: float
    f: float
    v: float
    x: float
    y: float
    w_low: float
    w_high: float
    y_low: float
    y_high: float
    x_offset: float
    gain: float
    lag_s: float
    dt_s: float
    duration_s: float


Starts: TypeAlias = Callable[[Range], list[tuple[float, ...]]]


@dataclass(frozen=True, kw_only=True)
class Entry:
    """An effect of the catalogue.

    Attributes
    ----------
    name : str
        PLACE.EFFECT.
    equation : str
        What it does, for people.
    parameters : tuple of Quantity
        Its parameters.
    starts : callable
        Starting values for a fit, from the sizes of the signals.
    needs : str
        Structure it makes sense in.
    forced : bool
        Whether it acts as a force at the plant's input.
    confusable : tuple of str
        Effects that can look alike.
    same : tuple of str
        Effects that cannot be told apart from it with command and measurement alone; itself not counted. Drifts of
        load and sensor are the same on a chain that settles; on others one of them simply explains nothing.
    places : tuple of str
        Where it may sit, several where command and measurement cannot say.
    reference : str
        Where the equation is from.
    """

    name: str
    equation: str
    parameters: tuple[Quantity, ...]
    starts: Starts
    needs: Needs = "any"
    forced: bool = False
    confusable: tuple[str, ...] = ()
    same: tuple[str, ...] = ()
    places: tuple[str, ...] = ()
    reference: str = ""

    @property
    def place(self) -> str:
        """The place in the effect's name."""
        return self.name.partition(".")[0]


def _limits(low: float, high: float, cuts: tuple[float, ...]) -> list[tuple[float, ...]]:
    """Return starts for two limits: the upper alone, the lower alone, both; one that does not act lies far outside."""
    span = high - low
    far = (low - 10.0 * span, high + 10.0 * span)
    starts: list[tuple[float, ...]] = []
    for c in cuts:
        inner = (low + c * span, high - c * span)
        starts += [(far[0], inner[1]), (inner[0], far[1]), inner]
    return starts


def _actuator() -> tuple[Entry, ...]:
    ljung = "Ljung, System Identification, 2nd ed., sec. 5.1"
    astrom = "Astrom and Hagglund, Advanced PID Control, 2006, ch. 9"
    return (
        Entry(
            name="actuator.saturation",
            equation="w = min(max(u, low), high)",
            parameters=(
                Quantity(name="low", unit="{u}", scale="real", slot=k.A_LOW),
                Quantity(name="high", unit="{u}", scale="real", slot=k.A_HIGH),
            ),
            starts=lambda s: _limits(s.w_low, s.w_high, (0.05, 0.15, 0.3)),
            confusable=("actuator.nonlinear_gain", "actuator.rate_limit"),
            reference=astrom,
        ),
        Entry(
            name="actuator.dead_zone",
            equation="w = 0 for |u - u0| < half_width, else u - u0 -+ half_width",
            parameters=(Quantity(name="half_width", unit="{u}", slot=k.A_DEAD_ZONE),),
            starts=lambda s: [(c * s.w,) for c in (0.01, 0.04, 0.12, 0.3)],
            confusable=("plant.coulomb_friction", "actuator.nonlinear_gain"),
            reference=astrom,
        ),
        Entry(
            name="actuator.rate_limit",
            equation="|dw/dt| <= rate",
            parameters=(Quantity(name="rate", unit="{u}/s", slot=k.A_RATE),),
            starts=lambda s: [(s.w / (c * s.lag_s),) for c in (0.03, 0.06, 0.1, 0.16, 0.25, 0.4, 0.6, 1.0, 1.5)],
            confusable=("actuator.lag",),
            reference=astrom,
        ),
        Entry(
            name="actuator.backlash",
            equation="w follows u - u0 with a play of the given width",
            parameters=(Quantity(name="width", unit="{u}", slot=k.A_BACKLASH),),
            starts=lambda s: [(c * s.w,) for c in (0.05, 0.2, 0.5)],
            confusable=("actuator.stiction", "timing.dead_time"),
            reference="Nordin and Gutman, Automatica 38, 2002",
        ),
        Entry(
            name="actuator.stiction",
            equation="w stays until |u - w| > band, then jumps to u",
            parameters=(Quantity(name="band", unit="{u}", slot=k.A_STICTION),),
            starts=lambda s: [],
            confusable=("actuator.backlash", "actuator.quantisation"),
            reference="Stenman, Gustafsson and Forsman, Int. J. Adapt. Control 17, 2003",
        ),
        Entry(
            name="actuator.lag",
            equation="time_constant dw/dt = u - w",
            parameters=(Quantity(name="time_constant", unit="s"),),
            starts=lambda s: [(c * s.lag_s,) for c in (0.05, 0.25)],
            confusable=("timing.dead_time", "actuator.rate_limit"),
            same=("sensor.lag",),
            places=("actuator", "sensor", "plant"),
            reference=ljung,
        ),
        Entry(
            name="actuator.asymmetric_lag",
            equation="the actuator's lag is time_constant_up when rising, time_constant_down when falling",
            parameters=(
                Quantity(name="time_constant_up", unit="s"),
                Quantity(name="time_constant_down", unit="s"),
            ),
            starts=lambda s: [
                (a * s.lag_s, b * s.lag_s) for a, b in ((0.05, 0.1), (0.1, 0.05), (0.15, 0.4), (0.4, 0.15))
            ],
            confusable=("actuator.lag", "actuator.nonlinear_gain"),
            reference=ljung,
        ),
        Entry(
            name="actuator.nonlinear_gain",
            equation="w = (u - u0) + second_order (u - u0)^2 + third_order (u - u0)^3",
            parameters=(
                Quantity(name="second_order", unit="1/{u}", scale="real", slot=k.A_SECOND),
                Quantity(name="third_order", unit="1/{u}^2", scale="real", slot=k.A_THIRD),
            ),
            starts=lambda s: [(0.05 / s.w, 1e-3 / s.w**2), (1e-3 / s.w, 0.05 / s.w**2)],
            confusable=("actuator.saturation", "sensor.nonlinear_gain"),
            reference=ljung,
        ),
        Entry(
            name="actuator.gain_drift",
            equation="w = (u - u0) (1 + rate t)",
            parameters=(Quantity(name="rate", unit="1/s", scale="real", slot=k.A_DRIFT),),
            starts=lambda s: [(0.01 / s.duration_s,)],
            confusable=("environment.drifting_load", "sensor.drift"),
            places=("actuator", "plant"),
            reference=ljung,
        ),
        Entry(
            name="actuator.quantisation",
            equation="w = origin + step round((u - origin) / step)",
            parameters=(
                Quantity(name="step", unit="{u}", slot=k.A_QUANTUM),
                Quantity(name="origin", unit="{u}", scale="real", slot=k.A_QUANTUM_ORIGIN),
            ),
            starts=lambda s: [],
            confusable=("actuator.stiction",),
            reference=astrom,
        ),
    )


def _plant() -> tuple[Entry, ...]:
    olsson = "Olsson, Astrom, Canudas de Wit, Gafvert and Lischinsky, Eur. J. Control 4, 1998"
    khalil = "Khalil, Nonlinear Systems, 3rd ed., ch. 1"
    return (
        Entry(
            name="plant.coulomb_friction",
            equation="force = -level sign(speed), sticking at rest",
            parameters=(Quantity(name="level", unit="{f}", slot=k.COULOMB),),
            starts=lambda s: [(c * s.f,) for c in (0.003, 0.015, 0.06, 0.2)],
            needs="mechanical",
            forced=True,
            confusable=("plant.stribeck_friction", "actuator.dead_zone", "plant.quadratic_drag"),
            reference=olsson,
        ),
        Entry(
            name="plant.stribeck_friction",
            equation="force = -(level + (breakaway - level) exp(-(v/stribeck_speed)^2)) sign(v)",
            parameters=(
                Quantity(name="level", unit="{f}", slot=k.COULOMB),
                Quantity(name="breakaway", unit="{f}", slot=k.BREAKAWAY),
                Quantity(name="stribeck_speed", unit="{v}", slot=k.STRIBECK_SPEED),
            ),
            starts=lambda s: [(c * s.f, 2.0 * c * s.f, d * s.v) for c in (0.02, 0.1) for d in (0.05, 0.2)],
            needs="mechanical",
            forced=True,
            confusable=("plant.coulomb_friction",),
            reference=olsson,
        ),
        Entry(
            name="plant.quadratic_drag",
            equation="tau dv/dt = -v - coefficient v |v| + gain w",
            parameters=(Quantity(name="coefficient", unit="1/({v})", slot=k.DRAG),),
            starts=lambda s: [(0.05 / s.v,), (0.5 / s.v,)],
            needs="mechanical",
            forced=True,
            confusable=("plant.coulomb_friction", "actuator.nonlinear_gain"),
            reference=khalil,
        ),
        Entry(
            name="plant.cubic_stiffness",
            equation="force = -coefficient x^3",
            parameters=(Quantity(name="coefficient", unit="{f}/{y}^3", scale="real", slot=k.CUBIC),),
            starts=lambda s: [(0.02 * s.f / s.x**3,), (0.3 * s.f / s.x**3,)],
            needs="mechanical",
            forced=True,
            confusable=("plant.leak", "plant.position_dependent_gain"),
            reference="Wigren and Schoukens, Three free data sets, ECC 2013",
        ),
        Entry(
            name="plant.position_dependent_gain",
            equation="w -> w (1 + slope x)",
            parameters=(Quantity(name="slope", unit="1/{y}", scale="real", slot=k.POSITION_GAIN),),
            starts=lambda s: [(0.02 / s.x,), (-0.02 / s.x,)],
            forced=True,
            confusable=("plant.leak", "actuator.nonlinear_gain", "sensor.nonlinear_gain"),
            reference=khalil,
        ),
        Entry(
            name="plant.hard_stop",
            equation="the position is held at a stop, blows are inelastic",
            parameters=(
                Quantity(name="low", unit="{y}", scale="real", slot=k.STOP_LOW),
                Quantity(name="high", unit="{y}", scale="real", slot=k.STOP_HIGH),
            ),
            # readings at a stop lie around it: it is beyond all but the farthest
            starts=lambda s: _limits(s.y_low, s.y_high, (-0.005, 0.02, 0.1)),
            confusable=("sensor.saturation",),
            reference=khalil,
        ),
        Entry(
            name="plant.sqrt_outflow",
            equation="outflow 2 X0 (sqrt(1 + x/X0) - 1) in place of x",
            parameters=(Quantity(name="operating_level", unit="{y}", slot=k.SQRT_1),),
            starts=lambda s: [(1.5 * s.x,), (6.0 * s.x,)],
            needs="level",
            forced=True,
            confusable=("actuator.nonlinear_gain", "sensor.nonlinear_gain", "plant.radiation_loss"),
            reference="Torricelli; Wigren and Schoukens, Three free data sets, ECC 2013",
        ),
        Entry(
            name="plant.resonance",
            equation="times omega^2 / (s^2 + 2 damping omega s + omega^2)",
            parameters=(Quantity(name="frequency", unit="Hz"), Quantity(name="damping", unit="")),
            starts=lambda s: [
                # a narrow peak is found from near it alone
                (c / (6.28 * s.lag_s), 0.08)
                for c in (1.3 * 1.3**i for i in range(12))
                if c * s.dt_s < 1.5 * s.lag_s
            ],
            confusable=("sensor.lag", "timing.dead_time"),
            places=("plant", "sensor"),
            reference=khalil,
        ),
        Entry(
            name="plant.hysteresis",
            equation="force = -amplitude z, dz/dt = (dx/dt - |dx/dt| z)/width",
            parameters=(
                Quantity(name="amplitude", unit="{f}", slot=k.HYSTERESIS),
                Quantity(name="width", unit="{y}", slot=k.HYSTERESIS_WIDTH),
            ),
            starts=lambda s: [(0.05 * s.f, c * s.x) for c in (0.05, 0.3)],
            forced=True,
            confusable=("plant.coulomb_friction", "actuator.backlash"),
            reference="Dahl, AIAA J. 14, 1976; Bouc and Wen with exponent 1",
        ),
        Entry(
            name="plant.radiation_loss",
            equation="tau dx/dt = -x - coefficient (T^4 - T0^4 - 4 T0^3 x) + gain w, T = T0 + x absolute",
            parameters=(Quantity(name="coefficient", unit="1/K^3", slot=k.RADIATION),),
            starts=lambda s: [(c / (s.x_offset + 273.15) ** 3,) for c in (0.02, 0.3)],
            needs="level",
            forced=True,
            confusable=("plant.sqrt_outflow", "actuator.nonlinear_gain", "sensor.nonlinear_gain"),
            reference="Stefan and Boltzmann",
        ),
        Entry(
            name="plant.leak",
            equation="force = -rate x / gain: the plant loses what it has stored",
            parameters=(Quantity(name="rate", unit="{v}/({y})", scale="real", slot=k.LEAK),),
            starts=lambda s: [(0.02 * abs(s.f * s.gain) / s.x,)],
            needs="integrating",
            forced=True,
            confusable=("plant.position_dependent_gain", "plant.cubic_stiffness"),
            reference=khalil,
        ),
        Entry(
            name="plant.sine_torque",
            equation="force = -amplitude sin(2 pi x / period + phase)",
            parameters=(
                Quantity(name="amplitude", unit="{f}", scale="real", slot=k.SINE),
                Quantity(name="period", unit="{y}", slot=k.SINE_PERIOD),
                Quantity(name="phase", unit="rad", scale="real", slot=k.SINE_PHASE),
            ),
            starts=lambda s: [
                (0.05 * s.f, p, a) for p in (0.3 * 1.25**i * s.x for i in range(13)) for a in (0.0, 1.57)
            ],
            needs="mechanical",
            forced=True,
            confusable=("plant.cubic_stiffness",),
            reference=khalil,
        ),
    )


def _sensor() -> tuple[Entry, ...]:
    ljung = "Ljung, System Identification, 2nd ed., sec. 5.1"
    return (
        Entry(
            name="sensor.saturation",
            equation="y = min(max(z, low), high)",
            parameters=(
                Quantity(name="low", unit="{y}", scale="real", slot=k.S_LOW),
                Quantity(name="high", unit="{y}", scale="real", slot=k.S_HIGH),
            ),
            starts=lambda s: _limits(s.y_low, s.y_high, (0.02, 0.1)),
            confusable=("plant.hard_stop",),
            reference=ljung,
        ),
        Entry(
            name="sensor.lag",
            equation="time_constant dy/dt = z - y",
            parameters=(Quantity(name="time_constant", unit="s"),),
            starts=lambda s: [(c * s.lag_s,) for c in (0.05, 0.25)],
            confusable=("timing.dead_time",),
            same=("actuator.lag",),
            places=("sensor", "actuator", "plant"),
            reference=ljung,
        ),
        Entry(
            name="sensor.quantisation",
            equation="y = step round(z / step)",
            parameters=(Quantity(name="step", unit="{y}", slot=k.S_QUANTUM),),
            starts=lambda s: [],
            reference=ljung,
        ),
        Entry(
            name="sensor.nonlinear_gain",
            equation="y = y0 + z + second_order z^2 + third_order z^3",
            parameters=(
                Quantity(name="second_order", unit="1/{y}", scale="real", slot=k.S_SECOND),
                Quantity(name="third_order", unit="1/{y}^2", scale="real", slot=k.S_THIRD),
            ),
            starts=lambda s: [(0.05 / s.x, 1e-3 / s.x**2), (1e-3 / s.x, 0.05 / s.x**2)],
            confusable=("actuator.nonlinear_gain", "plant.position_dependent_gain"),
            reference=ljung,
        ),
        Entry(
            name="sensor.absolute_value",
            equation="y = fold + |z - fold|, fold = 0 for a sensor that cannot tell the sign",
            parameters=(Quantity(name="fold", unit="{y}", scale="real", slot=k.S_ABSOLUTE),),
            starts=lambda s: [(s.y_low + c * (s.y_high - s.y_low),) for c in (0.005, 0.03, 0.1)],
            reference="a sensor that cannot tell the sign, as an encoder without direction",
        ),
        Entry(
            name="sensor.drift",
            equation="y = z + rate t",
            parameters=(Quantity(name="rate", unit="{y}/s", scale="real", slot=k.S_DRIFT),),
            starts=lambda s: [(0.01 * s.y / s.duration_s,)],
            confusable=("actuator.gain_drift",),
            same=("environment.drifting_load",),
            reference=ljung,
        ),
    )


def _rest() -> tuple[Entry, ...]:
    ljung = "Ljung, System Identification, 2nd ed., sec. 5.1"
    return (
        Entry(
            name="timing.dead_time",
            equation="u(t - delay)",
            parameters=(Quantity(name="delay", unit="s"),),
            starts=lambda s: [(c,) for c in (0.5 * s.dt_s, 2.5 * s.dt_s, 6.0 * s.dt_s, 14.0 * s.dt_s, 0.3 * s.lag_s)],
            confusable=("sensor.lag", "actuator.lag", "actuator.backlash"),
            places=("timing", "actuator", "sensor"),
            reference=ljung,
        ),
        Entry(
            name="timing.clock_error",
            equation="the command at stamp t acts at t (1 + error)",
            parameters=(Quantity(name="error", unit="", scale="real", slot=k.CLOCK),),
            starts=lambda s: [(0.2 * s.dt_s / s.duration_s,)],
            confusable=("timing.dead_time",),
            reference=ljung,
        ),
        Entry(
            name="environment.step_load",
            equation="force + amplitude from the time on",
            parameters=(
                Quantity(name="amplitude", unit="{f}", scale="real", slot=k.STEP),
                Quantity(name="time", unit="s", scale="real", slot=k.STEP_TIME),
                Quantity(name="end", unit="s", scale="real", slot=k.STEP_END),
                Quantity(name="recording", unit="", scale="real", slot=k.STEP_RECORDING),
            ),
            starts=lambda s: [],
            forced=True,
            confusable=("actuator.offset", "environment.drifting_load"),
            places=("environment", "actuator", "plant"),
            reference="Astrom and Hagglund, Advanced PID Control, 2006, ch. 4",
        ),
        Entry(
            name="environment.periodic_load",
            equation="force + amplitude sin(2 pi frequency t + phase)",
            parameters=(
                Quantity(name="in_phase", unit="{f}", scale="real", slot=k.PERIODIC_SIN),
                Quantity(name="quadrature", unit="{f}", scale="real", slot=k.PERIODIC_COS),
                Quantity(name="frequency", unit="Hz", slot=k.PERIODIC_FREQUENCY),
            ),
            starts=lambda s: [],
            forced=True,
            confusable=("plant.sine_torque",),
            places=("environment", "actuator", "plant"),
            reference="Astrom and Hagglund, Advanced PID Control, 2006, ch. 4",
        ),
        Entry(
            name="environment.drifting_load",
            equation="force + rate t",
            parameters=(Quantity(name="rate", unit="{f}/s", scale="real", slot=k.DRIFTING),),
            starts=lambda s: [(0.01 * s.f / s.duration_s,)],
            forced=True,
            confusable=("actuator.gain_drift",),
            same=("sensor.drift",),
            places=("environment", "actuator", "plant"),
            reference="Astrom and Hagglund, Advanced PID Control, 2006, ch. 4",
        ),
    )


#: Effects that are fitted by simulation, by their names.
CATALOGUE: dict[str, Entry] = {entry.name: entry for entry in (*_actuator(), *_plant(), *_sensor(), *_rest())}

#: Structures that are searched beside the effects and are none: what one of them explains better is not an effect's.
STRUCTURES: dict[str, Entry] = {
    "plant.slow_mode": Entry(
        name="plant.slow_mode",
        equation="times ((1 - share) time_constant s + 1) / (time_constant s + 1)",
        parameters=(Quantity(name="share", unit="", scale="real"), Quantity(name="time_constant", unit="s")),
        starts=lambda s: [(0.03, c * s.lag_s) for c in (2.5, 8.0)],
        needs="level",
        confusable=("plant.hysteresis", "environment.step_load", "environment.drifting_load"),
        places=("plant", "sensor"),
        reference="Ljung, System Identification, 2nd ed., sec. 16.4: the order of a linear model",
    )
}
