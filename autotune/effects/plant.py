"""Effects of the plant: forces at its input, dry friction, stops, and modes that its chain lacks.

One record and its functions per effect: the file is as long as its place has effects.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from autotune.arrays import FloatArray
from autotune.effects.actuator import limit_starts
from autotune.effects.base import (
    INTEGRATING,
    LEVEL,
    MECHANICAL,
    NEVER,
    POSITION_STATE,
    RUBBING,
    TRAVEL,
    EffectKind,
    Fitted,
    Quantity,
    SignalSizes,
    ends,
    lacking,
)
from autotune.effects.in_equations import HEATED, MOVING, STORED, Around, InEquations, Tried
from autotune.effects.stages import Blocks, Line, LinearPart, Memory, Values
from autotune.models import Block, Model, TransferFunction

_OLSSON = "Olsson, Astrom, Canudas de Wit, Gafvert and Lischinsky, Eur. J. Control 4, 1998"
_KHALIL = "Khalil, Nonlinear Systems, 3rd ed., ch. 1"
#: 0 degrees Celsius [K].
_ICE = 273.15
#: Temperature below which nothing is, so that a smaller one is no absolute one; how far surroundings may be from the
#: coldest that was met [K].
_COLDEST, _SURROUNDINGS_SD = 100.0, 15.0
#: Parameters of a friction that is larger at rest.
_STICKING = ("level", "breakaway")
#: Shares of the time that a position without a stop is on this side of it, where stops are tried, and how far a
#: position may go beyond one, of what it moves through: what gives way by more is no stop.
_STOPS, _BEYOND = (0.8, 0.9, 0.97, 0.995), 0.15
#: Width of a hysteresis, of what the position moves through, below which it is dry friction, which has no width: its
#: springs would swing the faster the narrower it is, and a simulation would follow them.
LEAST_WIDTH = 1.0 / 300.0


def dry(v: float, level: float) -> float:
    """Return the level of a friction that does not depend on speed.

    Parameters
    ----------
    v : float
        Speed [y unit/s]; not used.
    level : float
        Of the friction, as a force at the plant's input.
    """
    return level


def _yielded(z: float, through: float, level: float, transition: float) -> float:
    """Return the force of a damper that yields: dry friction over the speed of a plant that is a law."""
    if transition > 0.0:
        return z + level * math.tanh(through / transition)
    return z + (math.copysign(level, through) if through != 0.0 else 0.0)


def _dropping(v: float, level: float, breakaway: float, stribeck_speed: float) -> float:
    """Return the level of a friction that falls from breakaway as the speed grows."""
    ratio = v / stribeck_speed
    return level + (breakaway - level) * math.exp(-ratio * ratio)


def _dragged(v: float, gain: float, coefficient: float) -> float:
    """Return a drag as a force at the plant's input."""
    return -(coefficient * v * abs(v) / gain)


def _hardened(x: float, coefficient: float, low: float, high: float) -> float:
    """Return the force of a spring that grows with the cube of the travel."""
    c = min(max(x, low), high)
    return -(coefficient * c * c * c)


def weighed(w: float, x: float, slope: float, low: float, high: float) -> float:
    """Return what a gain over position adds to the plant's input.

    Parameters
    ----------
    w : float
        Plant input.
    x : float
        Position about the operating point [y unit].
    slope : float
        Of the gain over position, as a share [1/y unit].
    low, high : float
        Where it ends [y unit].
    """
    return slope * min(max(x, low), high) * w


def _cogging(
    x: float,
    y_offset: float,
    gain: float,
    amplitude: float,
    period: float,
    phase: float,
    gravity: float,
    low: float,
    high: float,
) -> float:
    """Return a force that is periodic in position; as gravity it takes the place of the spring that stood for it."""
    if gravity > 0.0:
        c, per_turn = min(max(x, low), high), period / (2.0 * math.pi)
        angle = (c + y_offset) / per_turn + phase
        return (c - per_turn * (math.sin(angle) - math.sin(angle - c / per_turn))) / gain
    return -(amplitude * math.sin(2.0 * math.pi * (x + y_offset) / period + phase))


def rising(x: float, gain: float, coefficient: float) -> float:
    """Return what a loss that grows with the square of the difference adds to the linear one.

    Parameters
    ----------
    x : float
        Level about the operating point [y unit].
    gain : float
        From force to level.
    coefficient : float
        Of the square [1/y unit].
    """
    return -(coefficient * x * abs(x) / gain)


def _held_back(turned: float, gain: float, amplitude: float) -> float:
    """Return the force of a hysteresis, against the travel whichever way a command moves the plant."""
    return -(math.copysign(amplitude, gain) * turned)


def turn(dx: float, width: float, turned: float) -> float:
    """Return how far a hysteresis has turned after a travel.

    Parameters
    ----------
    dx : float
        Travel [y unit].
    width : float
        Travel over which it turns [y unit].
    turned : float
        How far it had turned, -1 to 1.
    """
    travel = dx / width
    return min(max(turned + travel - abs(travel) * turned, -1.0), 1.0)


def _radiated(x: float, gain: float, kelvin: float, coefficient: float) -> float:
    """Return what the fourth power adds to the linear loss that the plant's own lag stands for."""
    return -(coefficient * ((kelvin + x) ** 4 - kelvin**4 - 4.0 * kelvin**3 * x) / gain)


def _leaked(x: float, gain: float, rate: float, low: float, high: float) -> float:
    """Return a leak as a force at the plant's input."""
    return -(rate * min(max(x, low), high) / gain)


def _excess(x: float, level: float) -> float:
    """Return x - q(x) for q(x) = 2 X0 (sqrt(1 + x/X0) - 1): what a square-root outflow lacks against a linear one."""
    return x - 2.0 * level * (math.sqrt(max(1.0 + x / level, 0.0)) - 1.0)


def outflow(level: float, gain: float, operating_level: float) -> float:
    """Return what the first level's outflow lacks, as a force at the plant's input.

    Parameters
    ----------
    level : float
        First level about the operating point [y unit].
    gain : float
        From force to level.
    operating_level : float
        Level at the operating point [y unit].
    """
    return _excess(level, operating_level) / gain


def _lower_outflow(x: float, level: float, gain_last: float, operating_level: float, operating_level_2: float) -> float:
    """Return the same for a lower tank: it gets the upper one's true outflow and gives a square-root one itself."""
    if operating_level_2 <= 0.0:
        return 0.0
    return _excess(x, operating_level_2) / gain_last - _excess(level, operating_level)


def stopped(x: float, v: float, y_offset: float, low: float, high: float) -> tuple[float, float]:
    """Hold the position inside hard stops; an impact on a stop is inelastic.

    Parameters
    ----------
    x, v : float
        Position [y unit] and speed [y unit/s] after a sub-step.
    y_offset : float
        Reading at position 0 [y unit].
    low, high : float
        The stops, as readings [y unit].
    """
    if x > high - y_offset:
        x = high - y_offset
        v = min(v, 0.0)
    if x < low - y_offset:
        x = low - y_offset
        v = max(v, 0.0)
    return x, v


def _kelvin(values: Values, model: Model) -> str:
    """Say what is wrong with an operating temperature."""
    zero = model.output.offset + (_ICE if "c" in model.output.unit.lower() else 0.0)
    return "" if zero > 0.0 else "radiation needs a positive absolute temperature"


def _is_friction_or_spring(fitted: Fitted) -> bool:
    """Whether a servo's hysteresis turns within the noise, as Coulomb friction does, or never, as a spring."""
    width = fitted.values["width"]
    return width > fitted.travelled or (fitted.mechanical and 0.0 < width < fitted.noise_sd)


def _is_slope(fitted: Fitted) -> bool:
    """Whether not one period of a load periodic in position was travelled."""
    gravity = fitted.values.get("gravity", 0.0) > 0.0
    return not gravity and fitted.values["period"] > fitted.travelled


def _is_gravity(values: Values) -> bool:
    """Whether a sine stands for gravity: one turn is its period, and the spring's stiffness its size."""
    return values.get("gravity", 0.0) > 0.0


def _sine_starts(s: SignalSizes) -> list[tuple[float, ...]]:
    """Return gravity where an angle is pulled back, else torques periodic in position."""
    if s.turn:
        return [(abs(s.turn / (2.0 * math.pi * s.gain)), s.turn, 0.0, 1.0)]
    periods = (0.3 * 1.25**i * s.x for i in range(13))
    return [(0.05 * s.f, period, phase, 0.0) for period in periods for phase in (0.0, 1.57)]


def _dry_starts(s: SignalSizes) -> list[tuple[float, ...]]:
    """Return levels of a dry friction, as forces at the plant's input; of a damper in the reading's unit."""
    if s.static:
        return [(c * s.y, d * s.f) for c in (0.3, 0.6) for d in (0.05, 0.2)]
    return [(c * s.f,) for c in (0.003, 0.015, 0.06, 0.2)]


def _is_two_lags(fitted: Fitted) -> bool:
    """Whether a mode does not ring: it is two lags by another name."""
    return fitted.values["damping"] >= 1.0


def _with_resonance(blocks: Blocks, values: Values) -> Blocks:
    omega = 2.0 * math.pi * values["frequency"]
    den = (1.0 / omega**2, 2.0 * values["damping"] / omega, 1.0)
    mode = Block(name="resonance", place="sensor", dynamics=TransferFunction(num=(1.0,), den=den))
    return (*blocks, mode)


def _resting_mode(u: FloatArray, y: FloatArray, values: Values) -> FloatArray:
    return np.column_stack([y, 0.0 * y])


def _with_slow_mode(blocks: Blocks, values: Values) -> Blocks:
    T, share = values["time_constant"], values["share"]
    lag = TransferFunction(num=((1.0 - share) * T, 1.0), den=(T, 1.0))
    return (*blocks, Block(name="slow mode", place="sensor", dynamics=lag))


def _peaks(s: SignalSizes) -> list[tuple[float, ...]]:
    """Return frequencies so close that a narrow peak, which is found from near it alone, is found."""
    spread = (1.3 * 1.3**i for i in range(12))
    return [(c / (6.28 * s.lag_s), 0.08) for c in spread if c * s.dt_s < 1.5 * s.lag_s]


def _cubes_tried(a: Around) -> list[Tried]:
    if not a.has_position:
        return []
    return [Tried({"coefficient": a.force / (float(np.quantile(np.abs(a.x), 0.95)) + 1e-300) ** 3}, ("coefficient",))]


def _stops_tried(a: Around) -> list[Tried]:
    """Return stops on either side of a position, that turn what moves round within a few samples.

    A level has no speed of its own: beyond its stop it flows off within a few samples.
    """
    if not (a.has_position or a.kind == "level"):
        return []
    stiffness = (0.5 / a.dt_s) ** 2 * a.per_rate
    give = {"stiffness": stiffness, "damping": 2.0 * a.dt_s * stiffness}
    if not a.has_position:
        give = {"stiffness": 0.5 / a.dt_s}
    at = [(side, share) for share in _STOPS for side in ("high", "low")]
    return [Tried({side: float(np.quantile(a.x, c if side == "high" else 1.0 - c)), **give}) for side, c in at]


def _gives_way(values: Values, x: FloatArray) -> bool:
    """Whether a position goes so far beyond a stop that it is none."""
    past = max(float(np.max(x)) - values.get("high", np.inf), values.get("low", -np.inf) - float(np.min(x)), 0.0)
    return past > _BEYOND * max(float(np.ptp(x)), 1e-300)


def _outflows_tried(a: Around) -> list[Tried]:
    is_level = float(np.quantile(a.v, 0.05)) >= -0.05 * a.largest
    return [Tried({"coefficient": a.force / np.sqrt(a.largest)}, ("coefficient",))] if is_level else []


def _radiation_tried(a: Around) -> list[Tried]:
    """Return a loss to surroundings as cold as the coldest that was met, where temperatures are absolute ones."""
    zero = 0.0 if a.unit.strip().lower() in ("k", "kelvin") else _ICE
    top, ground = float(np.max(a.v)) + zero, float(np.min(a.v)) + zero
    values = {"coefficient": a.force / max(top**4 - ground**4, 1e-300), "zero": zero, "surroundings": ground}
    return [Tried(values, ("coefficient",))] if top > _COLDEST else []


def gravity(amplitude: float) -> dict[str, float]:
    """Return a sine torque as gravity on an angle: over one turn, from angle zero on; its amplitude alone is sought."""
    return {"amplitude": amplitude, "period": 2.0 * np.pi}


def _sines_tried(a: Around) -> list[Tried]:
    """Return torques periodic in a position; gravity first, where that may be an angle."""
    if not a.has_position:
        return []
    found = [Tried(gravity(a.force), ("amplitude",))] if a.is_angle else []
    periods = (0.2 * a.span, 0.35 * a.span, 0.6 * a.span, 2.0 * np.pi)
    for period, phase in itertools.product(periods, (1e-3, 0.5 * np.pi)):
        found.append(Tried({"amplitude": a.force, "period": period, "phase": phase}, ("amplitude",)))
    return found


PLANT = (
    EffectKind(
        name="plant.coulomb_friction",
        words=("dry friction", "dry friction opposes the motion, whatever the speed"),
        equation="force = -level sign(speed), sticking at rest",
        parameters=(
            Quantity(name="level", unit="{f}", role="amplitude"),
            # of a damper, whose plant is a law: speed over which its force turns round
            Quantity(name="transition", unit="{f}", role="shape", neutral=0.0),
        ),
        lines=(Line(stage="friction", does=dry), Line(stage="sensor", does=_yielded)),
        sub_steps=2,
        needs=RUBBING,
        suits=RUBBING,
        starts=_dry_starts,
        rough=True,
        odds=lacking(expected="arm shaft carriage speed damper", usual="lifted oscillator"),
        in_equations=InEquations(
            acts="force",
            text="-level*sign(V)",
            on=MOVING,
            trials=lambda a: [Tried({"level": a.force}, ("level",))],
            usual=True,
            levels=("level",),
        ),
        reference=_OLSSON,
    ),
    EffectKind(
        name="plant.stribeck_friction",
        words=("friction at rest", "friction is larger at rest than in motion"),
        equation="force = -(level + (breakaway - level) exp(-(v/stribeck_speed)^2)) sign(v)",
        parameters=(
            Quantity(name="level", unit="{f}", role="amplitude"),
            Quantity(name="breakaway", unit="{f}", role="amplitude"),
            Quantity(name="stribeck_speed", unit="{v}", role="shape", nonzero=True),
        ),
        lines=(Line(stage="friction", does=_dropping),),
        sub_steps=2,
        needs=MECHANICAL,
        suits=MECHANICAL,
        starts=lambda s: [(c * s.f, 2.0 * c * s.f, d * s.v) for c in (0.02, 0.1) for d in (0.05, 0.2)],
        stand_in=lambda fitted: fitted.values["breakaway"] <= fitted.values["level"],
        rough=True,
        includes=("plant.coulomb_friction",),
        odds=lacking(usual="arm shaft carriage speed", possible="lifted oscillator"),
        in_equations=InEquations(
            acts="force",
            text="-(level + (breakaway - level)*exp(-(V/stribeck_speed)^2))*sign(V)",
            on=MOVING,
            trials=lambda a: [
                Tried({"level": a.force, "breakaway": 2.0 * a.force, "stribeck_speed": c * a.largest}, _STICKING)
                for c in (0.03, 0.15)
            ],
            levels=_STICKING,
            plainer=lambda values: ("plant.coulomb_friction", {"level": abs(values["level"])}),
            is_plainer=lambda values: values["breakaway"] <= values["level"],
        ),
        reference=_OLSSON,
    ),
    EffectKind(
        name="plant.viscous_friction",
        words=("friction", "friction grows with the speed"),
        equation="force = -coefficient v",
        parameters=(Quantity(name="coefficient", unit="{f}/({v})", role="amplitude"),),
        sought="equations",
        in_equations=InEquations(
            acts="force",
            text="-coefficient*V",
            on=MOVING,
            trials=lambda a: [Tried({"coefficient": a.force / a.largest}, ("coefficient",))],
        ),
        reference=_OLSSON,
    ),
    EffectKind(
        name="plant.quadratic_drag",
        words=("drag", "drag grows with the square of the speed"),
        equation="tau dv/dt = -v - coefficient v |v| + gain w",
        parameters=(Quantity(name="coefficient", unit="1/({v})", role="amplitude"),),
        lines=(Line(stage="force", does=_dragged),),
        needs=MECHANICAL,
        suits=MECHANICAL,
        starts=lambda s: [(0.05 / s.v,), (0.5 / s.v,)],
        odds=lacking(usual="arm shaft carriage speed lifted oscillator"),
        in_equations=InEquations(
            acts="force",
            text="-coefficient*V*abs(V)",
            on=MOVING,
            trials=lambda a: [Tried({"coefficient": a.force / a.largest**2}, ("coefficient",))],
        ),
        reference=_KHALIL,
    ),
    EffectKind(
        name="plant.cubic_stiffness",
        words=("curved spring", "the spring's stiffness changes with the travel"),
        equation="force = -coefficient x^3",
        parameters=(Quantity(name="coefficient", unit="{f}/{y}^3", role="amplitude", sign="real"), *ends("{y}")),
        lines=(Line(stage="force", does=_hardened),),
        goes_on=lambda values, x: values["coefficient"] * values["gain"] > 0.0,
        needs=TRAVEL,
        suits=TRAVEL,
        starts=lambda s: [(0.02 * s.f / s.x**3,), (0.3 * s.f / s.x**3,)],
        odds=lacking(usual="arm oscillator"),
        in_equations=InEquations(
            acts="force",
            text="-coefficient*X^3",
            on=MOVING,
            trials=_cubes_tried,
        ),
        reference="Wigren and Schoukens, Three free data sets, ECC 2013",
    ),
    EffectKind(
        name="plant.position_dependent_gain",
        words=("gain over position", "the plant's gain changes along its travel"),
        equation="w -> w (1 + slope x)",
        parameters=(Quantity(name="slope", unit="1/{y}", role="amplitude", sign="real"), *ends("{y}")),
        lines=(Line(stage="force", does=weighed),),
        goes_on=lambda values, x: 1.0 + values["slope"] * x > 0.0,
        starts=lambda s: [(0.02 / s.x,), (-0.02 / s.x,)],
        odds=lacking(usual="lifted"),
        in_equations=InEquations(
            acts="input",
            text="value*(1 + slope*X)",
            trials=lambda a: (
                [Tried({"slope": 0.05 / float(np.max(np.abs(a.x)))}, ("slope",))]
                if a.has_position and np.any(a.x)
                else []
            ),
        ),
        reference=_KHALIL,
    ),
    EffectKind(
        name="plant.hard_stop",
        words=("a stop", "the travel ends at a stop"),
        equation="the position is held at a stop, impacts are inelastic",
        parameters=(
            Quantity(name="low", unit="{y}", role="limit", sign="real", neutral=-NEVER),
            Quantity(name="high", unit="{y}", role="limit", sign="real", neutral=NEVER),
        ),
        lines=(Line(stage="stop", does=stopped),),
        sub_steps=2,
        needs=POSITION_STATE,
        # readings at a stop lie around it: it is beyond all but the farthest
        starts=lambda s: limit_starts(s.y_low, s.y_high, (-0.005, 0.02, 0.1)),
        impacts=True,
        odds=lacking(possible="carriage"),
        in_equations=InEquations(
            acts="force",
            text="if(X > high, -stiffness*(X - high) - damping*max(V, 0), 0)"
            " + if(X < low, -stiffness*(X - low) - damping*min(V, 0), 0)",
            on=(*MOVING, "level"),
            trials=_stops_tried,
            further=("stiffness",),
            defaults={"damping": 0.0},
            spread={"low": lambda s: s.span, "high": lambda s: s.span},
            # softer than what it turns round moves by itself it would be no stop, its damping a loss of free place
            least={"stiffness": lambda s: s.size / max(s.span, 1e-300)},
            stand_in=_gives_way,
        ),
        reference=_KHALIL,
    ),
    EffectKind(
        name="plant.sqrt_outflow",
        words=("root outflow", "the outflow grows with the root of the level"),
        equation="outflow 2 X0 (sqrt(1 + x/X0) - 1) in place of x",
        parameters=(
            Quantity(name="operating_level", unit="{y}", role="shape", nonzero=True),
            # of a lower tank, where there are two one above the other
            Quantity(name="operating_level_2", unit="{y}", role="shape", neutral=0.0, nonzero=True),
        ),
        lines=(Line(stage="force", does=outflow), Line(stage="outflow", does=_lower_outflow)),
        suits=LEVEL,
        starts=lambda s: [(c * s.x,) * (2 if s.levels == 2 else 1) for c in (1.5, 6.0)],
        odds=lacking(expected="level"),
        in_equations=InEquations(
            acts="force",
            text="-coefficient*sqrt(max(X, 0))",
            on=STORED,
            trials=_outflows_tried,
            further=("coefficient",),
        ),
        reference="Torricelli; Wigren and Schoukens, Three free data sets, ECC 2013",
    ),
    EffectKind(
        name="plant.resonance",
        words=("resonance", "the plant resonates, which the model does not"),
        equation="times omega^2 / (s^2 + 2 damping omega s + omega^2)",
        parameters=(
            Quantity(name="frequency", unit="Hz", role="time"),
            Quantity(name="damping", unit="", role="shape"),
        ),
        linear=LinearPart(blocks=_with_resonance, states=2, start=_resting_mode),
        starts=_peaks,
        stand_in=_is_two_lags,
        places=("plant", "sensor"),
        in_equations=InEquations(
            acts="reading",
            text="memory",
            memory=(
                ("memory", "memory_rate"),
                ("memory_rate", "(2*pi*frequency)^2*(value - memory) - 2*damping*(2*pi*frequency)*memory_rate"),
            ),
            follows=True,
            defaults={"damping": 0.0},
        ),
        reference=_KHALIL,
    ),
    EffectKind(
        name="plant.hysteresis",
        words=("hysteresis", "the force depends on the way that the position came"),
        equation="force = -amplitude z, dz/dt = (dx/dt - |dx/dt| z)/width",
        parameters=(
            Quantity(name="amplitude", unit="{f}", role="amplitude"),
            Quantity(name="width", unit="{y}", role="shape", nonzero=True),
        ),
        lines=(Line(stage="force", does=_held_back), Line(stage="travel", does=turn)),
        memory=Memory(name="turned", start="travel"),
        starts=lambda s: [(0.05 * s.f, c * s.x) for c in (0.05, 0.3)],
        rough=True,
        stand_in=_is_friction_or_spring,
        includes=("plant.coulomb_friction",),
        odds=lacking(possible="valve"),
        in_equations=InEquations(
            acts="force",
            text="-amplitude*memory",
            memory=(("memory", "(V - abs(V)*memory)/width"),),
            on=MOVING,
            trials=lambda a: [
                Tried({"amplitude": a.force, "width": c * a.span}, ("amplitude",))
                for c in (0.05, 0.25)
                if a.has_position
            ],
            either_sign=("amplitude",),
            least={"width": lambda s: LEAST_WIDTH * s.span},
            plainer=lambda values: ("plant.coulomb_friction", {"level": abs(values["amplitude"])}),
        ),
        reference="Dahl, AIAA J. 14, 1976; Bouc and Wen with exponent 1",
    ),
    EffectKind(
        name="plant.radiation_loss",
        words=("radiation", "heat is lost by radiation, with the fourth power of the temperature"),
        equation="tau dx/dt = -x - coefficient (T^4 - T0^4 - 4 T0^3 x) + gain w, T = T0 + x absolute",
        parameters=(Quantity(name="coefficient", unit="1/K^3", role="amplitude"),),
        lines=(Line(stage="force", does=_radiated),),
        suits=LEVEL,
        possible=_kelvin,
        starts=lambda s: [(c / (s.x_offset + _ICE) ** 3,) for c in (0.02, 0.3)],
        odds=lacking(possible="thermal"),
        in_equations=InEquations(
            acts="force",
            text="-coefficient*((X + zero)^4 - surroundings^4)",
            on=HEATED,
            trials=_radiation_tried,
            defaults={"zero": 0.0, "surroundings": 293.15},
            given=("zero",),
            either_sign=("surroundings",),
            spread={"surroundings": lambda s: _SURROUNDINGS_SD},
        ),
        reference="Stefan and Boltzmann",
    ),
    EffectKind(
        name="plant.nonlinear_loss",
        words=("growing loss", "the loss grows faster than the difference that drives it"),
        equation="tau dx/dt = -x - coefficient x |x| + gain w: a loss that grows faster than its difference",
        parameters=(Quantity(name="coefficient", unit="1/({y})", role="amplitude"),),
        lines=(Line(stage="force", does=rising),),
        sought="rig",
        suits=LEVEL,
        starts=lambda s: [(0.05 / s.x,), (0.5 / s.x,)],
        odds=lacking(possible="thermal"),
        in_equations=InEquations(
            acts="force",
            text="-coefficient*V*abs(V)",
            on=(*STORED, *HEATED),
            trials=lambda a: [Tried({"coefficient": a.force / a.largest**2}, ("coefficient",))],
        ),
        reference="Incropera and DeWitt, Fundamentals of Heat and Mass Transfer, ch. 9: free convection",
    ),
    EffectKind(
        name="plant.leak",
        words=("leak", "the plant loses what it has stored"),
        equation="force = -rate x / gain: the plant loses what it has stored",
        parameters=(Quantity(name="rate", unit="{v}/({y})", role="amplitude", sign="real"), *ends("{y}")),
        lines=(Line(stage="force", does=_leaked),),
        goes_on=lambda values, x: values["rate"] > 0.0,
        suits=INTEGRATING,
        starts=lambda s: [(0.02 * abs(s.f * s.gain) / s.x,)],
        odds=lacking(usual="lifted level thermal process", possible="carriage"),
        in_equations=InEquations(
            acts="force",
            text="-rate*X",
            on=(*STORED, *HEATED),
            trials=lambda a: [Tried({"rate": a.force / a.largest}, ("rate",))],
        ),
        reference=_KHALIL,
    ),
    EffectKind(
        name="plant.sine_torque",
        words=("periodic force", "a force repeats over the position, as gravity does on an arm"),
        equation="force = -amplitude sin(2 pi x / period + phase); as gravity it carries the stiffness",
        parameters=(
            Quantity(name="amplitude", unit="{f}", role="amplitude", sign="real", held=_is_gravity),
            Quantity(name="period", unit="{y}", role="shape", nonzero=True, held=_is_gravity),
            Quantity(name="phase", unit="rad", role="shape", sign="real", neutral=0.0),
            Quantity(name="gravity", unit="", role="mark", neutral=0.0),
            *ends("{y}"),  # of gravity: unwound, an arm would turn on and on where nobody has seen it
        ),
        lines=(Line(stage="force", does=_cogging),),
        goes_on=lambda values, x: True,
        needs=TRAVEL,
        suits=TRAVEL,
        starts=_sine_starts,
        stand_in=_is_slope,
        odds=lacking(expected="arm", possible="shaft"),
        in_equations=InEquations(
            acts="force",
            text="-amplitude*sin(2*pi*X/period + phase)",
            on=MOVING,
            trials=_sines_tried,
            held=lambda given: () if "phase" in given else ("period",),  # gravity on an angle
            spread={"phase": lambda s: 1.0},
            plainer=lambda values: (
                ("plant.sine_torque", gravity(abs(values["amplitude"]))) if "phase" in values else None
            ),
        ),
        reference=_KHALIL,
    ),
    EffectKind(
        name="plant.slow_mode",
        words=("slow mode", "a second, slow mode follows behind the first"),
        equation="times ((1 - share) time_constant s + 1) / (time_constant s + 1)",
        parameters=(
            Quantity(name="share", unit="", role="amplitude", sign="real"),
            Quantity(name="time_constant", unit="s", role="time"),
        ),
        linear=LinearPart(blocks=_with_slow_mode, states=1, start=lambda u, y, values: (values["share"] * y)[:, None]),
        sought="structure",
        suits=LEVEL,
        starts=lambda s: [(0.03, c * s.lag_s) for c in (2.5, 8.0)],
        places=("plant", "sensor"),
        in_equations=InEquations(
            acts="reading",
            text="(1 - share)*value + share*memory",
            memory=(("memory", "(value - memory)/time_constant"),),
            follows=True,
        ),
        reference="Ljung, System Identification, 2nd ed., sec. 16.4: the order of a linear model",
    ),
)
