"""Effects of time: dead time, clocks, and stamps that are not true."""

from __future__ import annotations

from dataclasses import replace

from autotune.effects.base import EffectKind, Quantity, lacking
from autotune.effects.in_equations import InEquations, Tried
from autotune.effects.stages import Blocks, Line, LinearPart, Values
from autotune.errors import InputError

_LJUNG = "Ljung, System Identification, 2nd ed., sec. 5.1"


def _stretched(elapsed: float, error: float) -> float:
    """Return when a command acts whose stamp was taken by a clock of another rate."""
    return elapsed * (1.0 + error)


def _with_delay(blocks: Blocks, values: Values) -> Blocks:
    first = blocks[0]
    total = first.dynamics.delay_s + values["delay"]
    if total < 0.0:
        raise InputError("the dead time is negative", where="timing.dead_time")
    return (replace(first, dynamics=replace(first.dynamics, delay_s=total)), *blocks[1:])


TIMING = (
    EffectKind(
        name="timing.dead_time",
        words=("dead time", "the command acts later than the model says"),
        equation="u(t - delay)",
        parameters=(Quantity(name="delay", unit="s", role="amplitude"),),
        linear=LinearPart(blocks=_with_delay),
        starts=lambda s: [(c,) for c in (0.5 * s.dt_s, 2.5 * s.dt_s, 6.0 * s.dt_s, 14.0 * s.dt_s, 0.3 * s.lag_s)],
        like=("actuator.lag", "sensor.lag"),
        places=("timing", "actuator", "sensor"),
        odds=lacking(usual="any", possible="damper"),
        in_equations=InEquations(
            acts="delay",
            trials=lambda a: [Tried({"delay": min(c * a.dt_s, a.slow_s)}) for c in (2.0, 8.0, 30.0)],
        ),
        reference=_LJUNG,
    ),
    EffectKind(
        name="timing.clock_error",
        words=("clock error", "the clock of the stamps runs at another rate"),
        equation="the command at stamp t acts at t (1 + error)",
        parameters=(Quantity(name="error", unit="", role="amplitude", sign="real"),),
        lines=(Line(stage="clock", does=_stretched),),
        starts=lambda s: [(0.2 * s.dt_s / s.duration_s,)],
        reference=_LJUNG,
    ),
    EffectKind(
        name="timing.jitter",
        words=("jitter", "samples are not taken when their stamps say"),
        equation="y is taken at t + d, d random from row to row",
        parameters=(Quantity(name="sd", unit="s", role="observed"),),
        sought="residual",
        uneven=True,
        late_stamps=True,
        in_equations=InEquations(acts="nothing"),
        reference=_LJUNG,
    ),
)
