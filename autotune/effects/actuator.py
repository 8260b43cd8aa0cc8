"""Effects of the actuator, in the order in which a command passes them.

One record and its functions per effect: the file is as long as its place has effects.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from autotune.arrays import FloatArray
from autotune.effects.base import (
    ACTUATOR_LAG,
    NEVER,
    EffectKind,
    Extent,
    Quantity,
    Scan,
    SignalSizes,
    ends,
    lacking,
)
from autotune.effects.converter import converter_steps
from autotune.effects.in_equations import Around, InEquations, Tried, curves
from autotune.effects.stages import Blocks, Line, LinearPart, Memory, Values
from autotune.models import Block, TransferFunction

_LJUNG = "Ljung, System Identification, 2nd ed., sec. 5.1"
_ASTROM = "Astrom and Hagglund, Advanced PID Control, 2006, ch. 9"
#: How far a converter's step is moved at first, as a share of what takes it a level off across the command's span, and
#: its origin, as a share of the step; how small a part of that is at last.
_MOVES, _LEAST_MOVE = (0.5, 0.1), 1.0 / 16.0
#: Bands of stiction that are tried: the smallest and the largest as a share of the command's size, count.
_BANDS_TRIED = (0.002, 0.6, 75)


def limit_starts(low: float, high: float, cuts: tuple[float, ...]) -> list[tuple[float, ...]]:
    """Return starts for two limits: the upper alone, the lower alone, both; one that does not act lies far outside.

    Parameters
    ----------
    low, high : float
        Range of the signal, in its unit.
    cuts : tuple of float
        Shares of the range that a limit cuts off.
    """
    span = high - low
    far = (low - 10.0 * span, high + 10.0 * span)
    starts: list[tuple[float, ...]] = []
    for c in cuts:
        inner = (low + c * span, high - c * span)
        starts += [(far[0], inner[1]), (inner[0], far[1]), inner]
    return starts


def converted(u: float, step: float, origin: float) -> float:
    """Return a converter's level for a command.

    Parameters
    ----------
    u : float
        Command [u unit].
    step : float
        Between two levels [u unit].
    origin : float
        One of the levels [u unit].
    """
    return origin + step * math.floor((u - origin) / step + 0.5)


def _levels_around(values: Values, extent: Extent, share: float) -> list[Values]:
    """Return a converter's steps, a part of what takes one a level off across u's span, and origins around."""
    if share < _LEAST_MOVE:
        return []
    step, origin, span = values["step"], values["origin"], extent.span
    wide, turn = (share * most for most in _MOVES)
    return [
        {"step": step * (1.0 + i * wide * step / max(span, step)), "origin": origin + k * turn * step}
        for i in (-1, 0, 1)
        for k in (-1, 0, 1)
        if i or k
    ]


def followed(w: float, width: float, held: float) -> tuple[float, float]:
    """Return the far side of a play, and where it stays.

    Parameters
    ----------
    w : float
        Near side [u unit].
    width : float
        Of the play [u unit].
    held : float
        Far side before [u unit].
    """
    half = 0.5 * width
    held = min(max(held, w - half), w + half)
    return held, held


def _stuck(w: float, band: float, slip: float, held: float) -> tuple[float, float]:
    """Return a sticking valve's position, and where it stays; it jumps to w, or to ``slip`` - ``band`` short of it."""
    if abs(w - held) > band:
        held = w - math.copysign(band - slip, w - held) if slip >= 0.0 else w
    return held, held


def _bands(scan: Scan) -> list[tuple[float, ...]]:
    """Return the best bands of a valve that sticks: every band moves other jumps, so peaks are narrow."""

    def tried(bands: FloatArray) -> list[tuple[float, tuple[float, ...]]]:
        return sorted(scan.predicted([(float(band),) for band in bands]), key=lambda one: -one[0])

    low, high, count = _BANDS_TRIED
    best = tried(scan.sizes.w * np.geomspace(low, high, count))[:3]
    ratio = (high / low) ** (1.0 / (count - 1))
    for _ in range(2):
        around = np.concatenate([band * ratio ** np.array([-0.6, -0.3, 0.3, 0.6]) for _, (band,) in best])
        best = sorted((*best, *tried(around)), key=lambda one: -one[0])[:2]
        ratio **= 0.3
    return [values for decrease, values in best if decrease > 0.0]


def _without_zone(w: float, half_width: float) -> float:
    """Return what a dead zone lets through."""
    return w - min(max(w, -half_width), half_width)


def curved(w: float, second_order: float, third_order: float, slope: float, low: float, high: float) -> float:
    """Return a command through a curved characteristic, which runs straight on beyond its ends.

    Parameters
    ----------
    w : float
        Command about the operating point [u unit].
    second_order, third_order : float
        Of the curve [1/u unit, 1/u unit^2].
    slope : float
        Slope beyond the ends.
    low, high : float
        The ends [u unit].
    """
    c = min(max(w, low), high)
    bent = c + second_order * c * c
    bent += third_order * bent * bent * bent
    return bent + slope * (w - c)


def rises(values: Values, w: float) -> bool:
    """Whether a curved characteristic still rises.

    Parameters
    ----------
    values : mapping of str to float
        The effect's parameters.
    w : float
        Command about the operating point [u unit].
    """
    bent = w + values["second_order"] * w * w
    return (1.0 + 2.0 * values["second_order"] * w) * (1.0 + 3.0 * values["third_order"] * bent * bent) > 0.0


def _limited(w: float, offset: float, low: float, high: float) -> float:
    """Return a command within absolute limits."""
    return min(max(w, low - offset), high - offset)


def _slewed(w: float, dt: float, rate: float, before: float) -> tuple[float, float]:
    """Return the mean of a rate-limited command over a sub-step, and its end."""
    reach = rate * dt
    end = before + min(max(w - before, -reach), reach)
    return 0.5 * (before + end), end


def _drifted(w: float, t: float, rate: float) -> float:
    """Return a command whose gain drifts."""
    return w * (1.0 + rate * t)


def _with_lag(blocks: Blocks, values: Values) -> Blocks:
    """Put a lag before the chain."""
    lag = TransferFunction(num=(1.0,), den=(max(values["time_constant"], 1e-12), 1.0))
    return (Block(name="added lag", place="actuator", dynamics=lag), *blocks)


def _with_time_constant(blocks: Blocks, time_constant: float) -> Blocks:
    """Give the first actuator lag a time constant, or put one in front."""
    for i, block in enumerate(blocks):
        if block.place == "actuator" and len(block.dynamics.den) == 2 and block.dynamics.den[1] != 0.0:
            gain = block.dynamics.num[-1] / block.dynamics.den[1]
            lag = TransferFunction(num=(gain,), den=(time_constant, 1.0), delay_s=block.dynamics.delay_s)
            return (*blocks[:i], replace(block, dynamics=lag), *blocks[i + 1 :])
    return _with_lag(blocks, {"time_constant": time_constant})


def _last_commands(u: FloatArray, y: FloatArray, values: Values) -> FloatArray:
    """Return an added lag at rest with the command before each window."""
    return u[:, None]


def _asymmetric_starts(s: SignalSizes) -> list[tuple[float, ...]]:
    return [(a * s.lag_s, b * s.lag_s) for a, b in ((0.05, 0.1), (0.1, 0.05), (0.15, 0.4), (0.4, 0.15))]


def _limits_tried(a: Around) -> list[Tried]:
    """Return limits above and below the middle of the command, and both."""
    top, bottom = (float(np.quantile(a.u, q)) for q in (0.999, 0.001))
    shares = [share * (top - bottom) for share in (0.05, 0.2, 0.4)]
    ends = [({"high": top - d}, {"low": bottom + d}, {"low": bottom + d, "high": top - d}) for d in shares]
    return [Tried(values) for some in ends for values in some]


def _usual_move(u: FloatArray) -> float:
    """Return how far a command moves; between its steps a held one says nothing of how fast it may."""
    size = float(np.std(u)) + 1e-300
    moves = np.abs(np.diff(u))
    moves = moves[moves > 1e-6 * size]
    return float(np.quantile(moves, 0.9)) if moves.size else size


ACTUATOR = (
    EffectKind(
        name="actuator.quantisation",
        words=("steps", "the command reaches the plant in steps"),
        equation="w = origin + step round((u - origin) / step)",
        parameters=(
            Quantity(name="step", unit="{u}", role="threshold", nonzero=True),
            Quantity(name="origin", unit="{u}", role="location", sign="real", neutral=0.0),
        ),
        lines=(Line(stage="converter", does=converted),),
        search=converter_steps,
        lasting=True,
        moves=_levels_around,
        rough=True,
        in_equations=InEquations(acts="held", samples="steps"),
        reference=_ASTROM,
    ),
    EffectKind(
        name="actuator.backlash",
        words=("play", "the actuator has play and follows late after every reversal"),
        equation="w follows u - u0 with a play of the given width",
        parameters=(Quantity(name="width", unit="{u}", role="amplitude"),),
        lines=(Line(stage="command", does=followed),),
        memory=Memory(name="held", start="replay"),
        starts=lambda s: [(c * s.w,) for c in (0.05, 0.2, 0.5)],
        rough=True,
        odds=lacking(expected="valve", usual="shaft process", possible="any", rare="lifted arm"),
        in_equations=InEquations(
            acts="held",
            samples="play",
            trials=lambda a: [Tried({"width": c * a.spread}) for c in (0.2, 0.6)],
        ),
        reference="Nordin and Gutman, Automatica 38, 2002",
    ),
    EffectKind(
        name="actuator.stiction",
        words=("stiction", "the actuator sticks, then jumps"),
        equation="w stays until |u - w| > band, then jumps to u",
        parameters=(
            Quantity(name="band", unit="{u}", role="threshold"),
            # where it is not negative the valve jumps that far instead of all the way
            Quantity(name="slip", unit="{u}", role="shape", sign="real", neutral=-1.0),
        ),
        lines=(Line(stage="command", does=_stuck),),
        memory=Memory(name="held", start="replay"),
        search=_bands,
        lasting=True,
        rough=True,
        includes=("actuator.backlash",),  # with a slip of 0 it is play
        odds=lacking(expected="valve", usual="process"),
        in_equations=InEquations(
            acts="held",
            samples="stick",
            jumps=("band",),
            trials=lambda a: [Tried({"band": c * a.spread}) for c in (0.2, 0.6)],
        ),
        reference="Stenman, Gustafsson and Forsman, Int. J. Adapt. Control 17, 2003",
    ),
    EffectKind(
        name="actuator.dead_zone",
        words=("dead zone", "small commands do nothing"),
        equation="w = 0 for |u - u0| < half_width, else u - u0 -+ half_width",
        parameters=(Quantity(name="half_width", unit="{u}", role="amplitude"),),
        lines=(Line(stage="command", does=_without_zone),),
        starts=lambda s: [(c * s.w,) for c in (0.01, 0.04, 0.12, 0.3)],
        rough=True,
        odds=lacking(usual="any", possible="thermal", rare="damper"),
        in_equations=InEquations(
            acts="input",
            text="value - min(max(value, -half_width), half_width)",
            trials=lambda a: [Tried({"half_width": c * a.spread}) for c in (0.1, 0.4)],
        ),
        reference=_ASTROM,
    ),
    EffectKind(
        name="actuator.nonlinear_gain",
        words=("curved gain", "the actuator's gain changes with the command"),
        equation="w = (u - u0) + second_order (u - u0)^2 + third_order (u - u0)^3",
        parameters=(
            Quantity(name="second_order", unit="1/{u}", role="amplitude", sign="real", neutral=0.0),
            Quantity(name="third_order", unit="1/{u}^2", role="amplitude", sign="real", neutral=0.0),
            Quantity(name="slope", unit="", role="mark", sign="real", neutral=1.0),
            *ends("{u}"),
        ),
        lines=(Line(stage="command", does=curved),),
        goes_on=rises,
        starts=lambda s: [(0.05 / s.w, 1e-3 / s.w**2), (1e-3 / s.w, 0.05 / s.w**2)],
        odds=lacking(usual="any", possible="carriage thermal shaft valve"),
        in_equations=InEquations(
            acts="input",
            text="value + second_order*(value - origin)^2 + third_order*(value - origin)^3",
            defaults={"origin": 0.0},
            either_sign=("origin",),
            spread={"origin": lambda s: s.u},
            trials=lambda a: curves(a.u),
        ),
        reference=_LJUNG,
    ),
    EffectKind(
        name="actuator.saturation",
        words=("limits", "the actuator gives no more beyond its limits"),
        equation="w = min(max(u, low), high)",
        parameters=(
            Quantity(name="low", unit="{u}", role="limit", sign="real", neutral=-NEVER),
            Quantity(name="high", unit="{u}", role="limit", sign="real", neutral=NEVER),
        ),
        lines=(Line(stage="command", does=_limited),),
        starts=lambda s: limit_starts(s.w_low, s.w_high, (0.05, 0.15, 0.3)),
        odds=lacking(usual="any"),
        in_equations=InEquations(
            acts="input",
            text="min(max(value, low), high)",
            spread={"low": lambda s: s.u, "high": lambda s: s.u},
            trials=_limits_tried,
        ),
        reference=_ASTROM,
    ),
    EffectKind(
        name="actuator.rate_limit",
        words=("rate limit", "the actuator moves no faster than a limit"),
        equation="|dw/dt| <= rate",
        parameters=(Quantity(name="rate", unit="{u}/s", role="threshold"),),
        lines=(Line(stage="command", does=_slewed),),
        memory=Memory(name="before"),
        sub_steps=4,
        starts=lambda s: [(s.w / (c * s.lag_s),) for c in (0.03, 0.06, 0.1, 0.16, 0.25, 0.4, 0.6, 1.0, 1.5)],
        in_equations=InEquations(
            acts="input",
            text="memory",
            memory=(("memory", "rate*sign(value - memory)"),),
            follows=True,
            trials=lambda a: [Tried({"rate": _usual_move(a.u) / (c * a.dt_s)}) for c in (3.0, 10.0, 30.0)],
        ),
        reference=_ASTROM,
    ),
    EffectKind(
        name="actuator.gain_drift",
        words=("drifting gain", "the actuator's gain drifts with time"),
        equation="w = (u - u0) (1 + rate t)",
        parameters=(Quantity(name="rate", unit="1/s", role="amplitude", sign="real"),),
        lines=(Line(stage="command", does=_drifted),),
        starts=lambda s: [(0.01 / s.duration_s,)],
        places=("actuator", "plant"),
        at_a_time=True,
        in_equations=InEquations(
            acts="input",
            text="value*(1 + rate*t)",
            trials=lambda a: [Tried({"rate": 0.05 / a.duration_s}, ("rate",))],
        ),
        reference=_LJUNG,
    ),
    EffectKind(
        name="actuator.lag",
        words=("a lag", "the command passes a lag that the model does not have"),
        equation="time_constant dw/dt = u - w",
        parameters=(Quantity(name="time_constant", unit="s", role="amplitude"),),
        linear=LinearPart(blocks=_with_lag, states=1, at="front", start=_last_commands),
        starts=lambda s: [(c * s.lag_s,) for c in (0.05, 0.25)],
        same=("sensor.lag",),
        like=("timing.dead_time",),
        places=("actuator", "sensor", "plant"),
        odds=lacking(usual="any", possible="damper"),
        in_equations=InEquations(
            acts="input",
            text="memory",
            memory=(("memory", "(value - memory)/time_constant"),),
            follows=True,
            trials=lambda a: [Tried({"time_constant": min(c * a.dt_s, a.slow_s)}) for c in (2.0, 8.0, 30.0)],
        ),
        reference=_LJUNG,
    ),
    EffectKind(
        name="actuator.asymmetric_lag",
        words=("uneven lag", "the actuator is slower one way than the other"),
        equation="the actuator's lag is time_constant_up when rising, time_constant_down when falling",
        parameters=(
            Quantity(name="time_constant_up", unit="s", role="time"),
            Quantity(name="time_constant_down", unit="s", role="time"),
        ),
        linear=LinearPart(
            blocks=lambda blocks, values: _with_time_constant(blocks, values["time_constant_up"]),
            falling=lambda blocks, values: _with_time_constant(blocks, values["time_constant_down"]),
            states=1,
            at="front",
            unless_lagged=True,
            start=_last_commands,
        ),
        sub_steps=2,
        needs=ACTUATOR_LAG,
        starts=_asymmetric_starts,
        in_equations=InEquations(
            acts="input",
            text="memory",
            memory=(("memory", "(value - memory)/if(value > memory, time_constant_up, time_constant_down)"),),
            follows=True,
        ),
        reference=_LJUNG,
    ),
    EffectKind(
        name="actuator.offset",
        words=("offset", "the command's operating point is another one"),
        equation="w = u - u0 + offset",
        parameters=(Quantity(name="offset", unit="{u}", role="amplitude", sign="real"),),
        linear=LinearPart(u_offset=lambda values: -values["offset"]),
        sought="operating point",
        same=("environment.step_load",),
        places=("actuator", "environment", "plant"),
        in_equations=InEquations(
            acts="input",
            text="value + offset",
            trials=lambda a: [Tried({"offset": 0.05 * a.spread}, ("offset",))],
        ),
        reference=_ASTROM,
    ),
)
