"""Effects of the sensor, in the order in which a reading passes them; what single samples show last."""

from __future__ import annotations

import math

from autotune.arrays import FloatArray
from autotune.effects.actuator import limit_starts, rises
from autotune.effects.base import NEVER, EffectKind, Quantity, ends, lacking
from autotune.effects.in_equations import InEquations, Tried, curves
from autotune.effects.stages import Blocks, Line, LinearPart, Values
from autotune.models import Block, TransferFunction

_LJUNG = "Ljung, System Identification, 2nd ed., sec. 5.1"


def curved(z: float, second_order: float, third_order: float, low: float, high: float) -> float:
    """Return a reading through a curved characteristic, which runs straight on beyond its ends.

    Parameters
    ----------
    z : float
        Reading about the operating point [y unit].
    second_order, third_order : float
        Of the curve [1/y unit, 1/y unit^2].
    low, high : float
        Where it runs straight on [y unit].
    """
    c = min(max(z, low), high)
    bent = c + second_order * c * c
    bent += third_order * bent * bent * bent
    return z + (bent - c)


def _drifted(z: float, t: float, rate: float) -> float:
    """Return a reading that drifts."""
    return z + rate * t


def _folded(y: float, fold: float) -> float:
    """Return a reading without its sign."""
    return fold + abs(y - fold)


def _limited(y: float, low: float, high: float) -> float:
    """Return a reading within the sensor's range."""
    return min(max(y, low), high)


def _rounded(y: float, step: float) -> float:
    """Return a converter's level for a reading."""
    return step * math.floor(y / step + 0.5)


def _with_lag(blocks: Blocks, values: Values) -> Blocks:
    """Put a lag behind the chain."""
    lag = TransferFunction(num=(1.0,), den=(max(values["time_constant"], 1e-12), 1.0))
    return (*blocks, Block(name="added lag", place="sensor", dynamics=lag))


def _last_outputs(u: FloatArray, y: FloatArray, values: Values) -> FloatArray:
    """Return an added lag at rest with the chain's output."""
    return y[:, None]


SENSOR = (
    EffectKind(
        name="sensor.lag",
        words=("a lag", "the reading passes a lag that the model does not have"),
        equation="time_constant dy/dt = z - y",
        parameters=(Quantity(name="time_constant", unit="s", role="amplitude"),),
        linear=LinearPart(blocks=_with_lag, states=1, start=_last_outputs),
        starts=lambda s: [(c * s.lag_s,) for c in (0.05, 0.25)],
        same=("actuator.lag",),
        like=("timing.dead_time",),
        recoordinates=True,
        places=("sensor", "actuator", "plant"),
        odds=lacking(usual="any", possible="damper"),
        in_equations=InEquations(
            acts="reading",
            text="memory",
            memory=(("memory", "(value - memory)/time_constant"),),
            follows=True,
            trials=lambda a: [Tried({"time_constant": min(c * a.dt_s, a.slow_s)}) for c in (3.0, 15.0)],
        ),
        reference=_LJUNG,
    ),
    EffectKind(
        name="sensor.nonlinear_gain",
        words=("curved sensor", "the sensor's gain changes with what it reads"),
        equation="y = y0 + z + second_order z^2 + third_order z^3",
        parameters=(
            Quantity(name="second_order", unit="1/{y}", role="amplitude", sign="real", neutral=0.0),
            Quantity(name="third_order", unit="1/{y}^2", role="amplitude", sign="real", neutral=0.0),
            *ends("{y}"),
        ),
        lines=(Line(stage="sensor", does=curved),),
        goes_on=rises,
        starts=lambda s: [(0.05 / s.x, 1e-3 / s.x**2), (1e-3 / s.x, 0.05 / s.x**2)],
        recoordinates=True,
        odds=lacking(possible="level"),
        in_equations=InEquations(
            acts="reading",
            text="value + second_order*(value - origin)^2 + third_order*(value - origin)^3",
            defaults={"origin": 0.0},
            either_sign=("origin",),
            spread={"origin": lambda s: s.y},
            trials=lambda a: curves(a.y),
        ),
        reference=_LJUNG,
    ),
    EffectKind(
        name="sensor.drift",
        words=("drift", "the reading drifts with time"),
        equation="y = z + rate t",
        parameters=(Quantity(name="rate", unit="{y}/s", role="amplitude", sign="real"),),
        lines=(Line(stage="sensor", does=_drifted),),
        starts=lambda s: [(0.01 * s.y / s.duration_s,)],
        same=("environment.drifting_load",),
        at_a_time=True,
        in_equations=InEquations(
            acts="reading",
            text="value + rate*t",
            trials=lambda a: [Tried({"rate": a.force / a.duration_s}, ("rate",))],
        ),
        reference=_LJUNG,
    ),
    EffectKind(
        name="sensor.absolute_value",
        words=("no sign", "the sensor cannot tell the sign"),
        equation="y = fold + |z - fold|, fold = 0 for a sensor that cannot tell the sign",
        parameters=(Quantity(name="fold", unit="{y}", role="threshold", sign="real"),),
        lines=(Line(stage="reading", does=_folded),),
        starts=lambda s: [(s.y_low + c * (s.y_high - s.y_low),) for c in (0.005, 0.03, 0.1)],
        in_equations=InEquations(acts="reading", text="fold + abs(value - fold)", defaults={"fold": 0.0}),
        reference="a sensor that cannot tell the sign, as an encoder without direction",
    ),
    EffectKind(
        name="sensor.saturation",
        words=("sensor limits", "the sensor reads no further than its limits"),
        equation="y = min(max(z, low), high)",
        parameters=(
            Quantity(name="low", unit="{y}", role="limit", sign="real", neutral=-NEVER),
            Quantity(name="high", unit="{y}", role="limit", sign="real", neutral=NEVER),
        ),
        lines=(Line(stage="reading", does=_limited),),
        starts=lambda s: limit_starts(s.y_low, s.y_high, (0.02, 0.1)),
        flattens=True,
        odds=lacking(possible="any", rare="lifted"),
        in_equations=InEquations(acts="reading", text="min(max(value, low), high)"),
        reference=_LJUNG,
    ),
    EffectKind(
        name="sensor.quantisation",
        words=("steps", "the reading comes in steps"),
        equation="y = step round(z / step)",
        parameters=(Quantity(name="step", unit="{y}", role="threshold", nonzero=True),),
        lines=(Line(stage="reading", does=_rounded),),
        sought="samples",
        steps=True,
        # a reading that was rounded is off by less where it stands still: that is no jitter
        excludes=("timing.jitter",),
        in_equations=InEquations(acts="converter"),
        reference=_LJUNG,
    ),
    EffectKind(
        name="sensor.dropout",
        words=("missing samples", "samples are missing and the last reading is repeated"),
        equation="y repeats its last value while a sample is missing",
        parameters=(
            Quantity(name="share", unit="-", role="observed"),
            Quantity(name="rows", unit="-", role="observed"),
        ),
        sought="samples",
        in_equations=InEquations(acts="nothing"),
        reference=_LJUNG,
    ),
    EffectKind(
        name="sensor.outliers",
        words=("outliers", "single readings are far off"),
        equation="y = z + spikes of either sign at single rows",
        parameters=(
            Quantity(name="share", unit="-", role="observed"),
            Quantity(name="size", unit="{y}", role="observed"),
        ),
        sought="samples",
        uneven=True,
        in_equations=InEquations(acts="nothing"),
        reference="Ljung, System Identification, 2nd ed., sec. 15.2",
    ),
)
