"""Effects of the environment: loads at the plant's input that no state of the rig changes."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from autotune.effects.base import LEVEL, NEVER, EffectKind, Extent, Quantity, Scan, lacking
from autotune.effects.in_equations import LOADED, Around, InEquations, Tried
from autotune.effects.stages import Line, Values
from autotune.models import Parameter

_LJUNG = "Ljung, System Identification, 2nd ed., sec. 1.1: measured disturbances"
_ASTROM = "Astrom and Hagglund, Advanced PID Control, 2006, ch. 4"
_PLACES = ("environment", "actuator", "plant")
#: Size of a load that is tried, as a share of the plant's largest input.
_TRIED = 0.02
#: Times at which a step is tried in models of equations, and the parts of a sinusoid.
_LOAD_TIMES, _PARTS = 24, ("in_phase", "quadrature")
#: Lags between a recorded column and what it acts on, as shares of the way from a sample to the slowest, in logarithms.
_LAGS = (0.3, 0.65, 1.0)
#: Candidate times of a step per recording.
_STEP_TIMES = 16
#: Lines of the residual at which a periodic load is tried; steps in which its frequency is searched around each, in
#: units of one over the longest recording's duration.
_LINES, _RESOLVED = 3, 0.1
#: Highest frequency at which a load is looked for: as a share of the sampling rate, and times the slowest lag.
_FASTEST_SAMPLED, _FASTEST_LAGGED = 0.2, 10.0


def stepped(t: float, number: float, amplitude: float, time: float, end: float, recording: float) -> float:
    """Return a load that stands for a time, in one recording or in all.

    Parameters
    ----------
    t : float
        Time in the recording [s].
    number : float
        Of the recording.
    amplitude : float
        Of the load, as a force at the plant's input.
    time, end : float
        From when until when it stands [s].
    recording : float
        Number of the one that has it, or -1.
    """
    return amplitude if (recording < 0.0 or number == recording) and time <= t < end else 0.0


def _regained(w: float, t: float, number: float, change: float, time: float, end: float, recording: float) -> float:
    """Return a command whose gain is another one from a time on."""
    return w + stepped(t, number, change, time, end, recording) * w


def opened(
    x: float,
    gain: float,
    t: float,
    number: float,
    change: float,
    time: float,
    end: float,
    recording: float,
) -> float:
    """Return what a loss that is larger from a time on takes, as a force at the plant's input.

    Parameters
    ----------
    x : float
        Position or level about the operating point [y unit].
    gain : float
        From force to level.
    t : float
        Time in the recording [s].
    number : float
        Of the recording.
    change : float
        What the loss grows by.
    time, end : float
        From when until when it is larger [s].
    recording : float
        Number of the one that has it, or -1.
    """
    return -(stepped(t, number, change, time, end, recording) * x / gain)


def swinging(t: float, in_phase: float, quadrature: float, frequency: float) -> float:
    """Return a sinusoidal load.

    Parameters
    ----------
    t : float
        Time in the recording [s].
    in_phase, quadrature : float
        Amplitudes of sine and cosine, as forces at the plant's input.
    frequency : float
        In Hz.
    """
    angle = 2.0 * math.pi * frequency * t
    return in_phase * math.sin(angle) + quadrature * math.cos(angle)


def growing(t: float, rate: float) -> float:
    """Return a load that drifts.

    Parameters
    ----------
    t : float
        Time in the recording [s].
    rate : float
        Growth in a second, as a force at the plant's input.
    """
    return rate * t


def _step_times(scan: Scan) -> list[tuple[float, ...]]:
    """Return the best step load."""
    return _best_step(scan, _TRIED * scan.sizes.f_peak or 1.0)


def _switch_times(scan: Scan) -> list[tuple[float, ...]]:
    """Return the best step of a share."""
    return _best_step(scan, _TRIED)


def _best_step(scan: Scan, size: float) -> list[tuple[float, ...]]:
    """Return the best step of a size: its time is searched on a grid, then around the best.

    It comes in one of the recordings, or in all at the same time (number -1), as a test that is repeated brings it.
    """

    def best_of(times: list[tuple[int, float]]) -> tuple[float, tuple[float, ...]]:
        return max(scan.predicted([(size, t, NEVER, float(i)) for i, t in times]), key=lambda one: one[0])

    grid, step = [], 0.0
    for i, duration in enumerate(scan.durations_s):
        step = duration / (_STEP_TIMES + 1)
        grid += [(i, step * (k + 1)) for k in range(_STEP_TIMES)]
    if len(scan.durations_s) > 1:
        grid += [(-1, step * (k + 1)) for k in range(_STEP_TIMES)]
    best = best_of(grid)
    for _ in range(3):
        _, at, _, number = best[1]
        step /= 3.0
        closer = best_of([(int(number), at + k * step) for k in (-2, -1, 1, 2)])
        if closer[0] > best[0]:
            best = closer
    return [best[1]] if best[0] > 0.0 else []


def _swings(scan: Scan) -> list[tuple[float, ...]]:
    """Return periodic loads at the strongest lines of the residual; far above the plant's corner no load shows."""
    duration = max(scan.durations_s)
    frequencies, power = scan.lines_over_time()
    highest = _FASTEST_SAMPLED / scan.sizes.dt_s
    if scan.slowest_lag_s > 0.0:  # an integrator has no corner
        highest = min(highest, _FASTEST_LAGGED / scan.slowest_lag_s)
    use = (frequencies >= 1.0 / duration) & (frequencies <= highest)
    frequencies, power = frequencies[use], power[use]
    if frequencies.size < 3:
        return []
    inner = np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] >= power[2:])) + 1
    lines = inner[np.argsort(-power[inner])][:_LINES]
    size = _TRIED * scan.sizes.f_peak or 1.0

    def sinusoid(frequency: float) -> tuple[float, tuple[float, ...]]:
        decrease, parts = scan.together([(size, 0.0, frequency), (0.0, size, frequency)])
        return decrease, (float(size * parts[0]), float(size * parts[1]), frequency)

    # the load's own frequency lies beside the residual's line: within a tenth of what the recordings resolve
    near = [[float(frequencies[line]) + k * _RESOLVED / duration for k in range(-2, 3)] for line in lines]
    return [max((sinusoid(f) for f in group), key=lambda found: found[0])[1] for group in near]


def _acts_in(values: Values) -> tuple[int, float]:
    return int(values["recording"]), values["time"]


def _as_amplitude(parameters: Mapping[str, Parameter]) -> dict[str, Parameter]:
    """Return a sinusoid's two parts as amplitude and phase."""
    shown = dict(parameters)
    a, b = shown.pop("in_phase"), shown.pop("quadrature")
    size = math.hypot(a.value, b.value)
    sd = math.hypot(a.value * a.sd, b.value * b.sd) / size if size else math.nan
    shown["amplitude"] = Parameter(value=size, sd=sd, unit=a.unit)
    shown["phase"] = Parameter(value=math.atan2(b.value, a.value), unit="rad")
    return shown


def _step_of(name: str, unit: str) -> tuple[Quantity, ...]:
    """Return the parameters of what changes at a time."""
    return (
        Quantity(name=name, unit=unit, role="amplitude", sign="real"),
        Quantity(name="time", unit="s", role="location", sign="real", neutral=0.0),
        Quantity(name="end", unit="s", role="mark", sign="real", neutral=math.inf),
        Quantity(name="recording", unit="", role="mark", sign="real", neutral=-1.0),
    )


def _times_around(values: Values, extent: Extent, share: float) -> list[Values]:
    """Return times before and after one of change, a sixteenth of a recording away at first, half a sample at last."""
    shift = share * extent.duration_s / 16.0
    return [{"time": values["time"] + side * shift} for side in (-1.0, 1.0)] if shift > 0.5 * extent.dt_s else []


def _without_lag(values: Values) -> tuple[str, dict[str, float]] | None:
    """Return a column that acts at once in place of one behind a lag."""
    at_once = {key: value for key, value in values.items() if key != "time_constant"}
    return ("environment.measured_input", at_once) if len(at_once) < len(values) else None


def _column_trials(a: Around) -> list[Tried]:
    """Return recorded columns as they are and from their mean on, at once and with a lag."""
    lags = [a.dt_s * float(np.exp(share * np.log(a.slow_s / a.dt_s))) for share in _LAGS]
    found = []
    for column, d in a.columns.items():
        for reference in dict.fromkeys((0.0, float(np.mean(d)))):
            values = {"gain": a.force / float(np.std(d)), "reference": reference}
            found += [Tried(values | late, ("gain",), column) for late in ({}, *({"time_constant": s} for s in lags))]
    return found


ENVIRONMENT = (
    EffectKind(
        name="environment.step_load",
        words=("a load", "a load comes at a time and stays"),
        equation="force + amplitude from the time on",
        parameters=_step_of("amplitude", "{f}"),
        lines=(Line(stage="load", does=stepped),),
        search=_step_times,
        moves=_times_around,
        acts_in=_acts_in,
        places=_PLACES,
        at_a_time=True,
        in_equations=InEquations(
            acts="force",
            text="if(t >= time, if(t < end, amplitude, 0), 0)",
            on=LOADED,
            trials=lambda a: [
                Tried({"amplitude": a.force, "time": float(c) * a.duration_s}, ("amplitude",))
                for c in np.linspace(0.04, 0.96, _LOAD_TIMES)
            ],
            given=("end",),
            spread={"time": lambda s: 0.2 * s.duration_s},
            free_timing=True,
        ),
        reference=_ASTROM,
    ),
    EffectKind(
        name="environment.periodic_load",
        words=("periodic load", "a load swings at a frequency of its own"),
        equation="force + amplitude sin(2 pi frequency t + phase)",
        parameters=(
            Quantity(
                name="in_phase", unit="{f}", role="amplitude", sign="real", neutral=0.0, size_with=("quadrature",)
            ),
            Quantity(
                name="quadrature", unit="{f}", role="amplitude", sign="real", neutral=0.0, size_with=("in_phase",)
            ),
            Quantity(name="frequency", unit="Hz", role="time", turns=True),
        ),
        lines=(Line(stage="load", does=swinging),),
        search=_swings,
        readable=_as_amplitude,
        places=_PLACES,
        in_equations=InEquations(
            acts="force",
            text="in_phase*sin(2*pi*frequency*t) + quadrature*cos(2*pi*frequency*t)",
            on=LOADED,
            trials=lambda a: [
                Tried({one: a.force, other: 2e-5 * a.force, "frequency": line}, (one,))
                for line in a.lines
                for one, other in (_PARTS, _PARTS[::-1])
            ],
            spread={key: lambda s: s.size for key in _PARTS},
            free_timing=True,
        ),
        reference=_ASTROM,
    ),
    EffectKind(
        name="environment.drifting_load",
        words=("drifting load", "a load grows with time"),
        equation="force + rate t",
        parameters=(Quantity(name="rate", unit="{f}/s", role="amplitude", sign="real"),),
        lines=(Line(stage="load", does=growing),),
        starts=lambda s: [(0.01 * s.f / s.duration_s,)],
        same=("sensor.drift",),
        places=_PLACES,
        at_a_time=True,
        odds=lacking(possible="any", rare="damper"),
        in_equations=InEquations(
            acts="force",
            text="rate*t",
            on=LOADED,
            trials=lambda a: [Tried({"rate": a.force / a.duration_s}, ("rate",))],
            free_timing=True,
        ),
        reference=_ASTROM,
    ),
    EffectKind(
        name="environment.gain_step",
        words=("a switched gain", "from a time on a command does more, or less, than before"),
        equation="w = (u - u0) (1 + change) from the time on: a pump, a voltage, another mode of working",
        parameters=_step_of("change", ""),
        lines=(Line(stage="command", does=_regained),),
        sought="rig",
        search=_switch_times,
        moves=_times_around,
        acts_in=_acts_in,
        places=_PLACES,
        at_a_time=True,
        odds=lacking(possible="thermal level speed"),
        reference=_ASTROM,
    ),
    EffectKind(
        name="environment.loss_step",
        words=("a switched loss", "from a time on the plant loses more, or less, of what it has stored"),
        equation="tau dx/dt = -(1 + change) x + gain w from the time on: a lid opened, a valve, water added",
        parameters=_step_of("change", ""),
        lines=(Line(stage="force", does=opened),),
        sought="rig",
        suits=LEVEL,
        search=_switch_times,
        moves=_times_around,
        acts_in=_acts_in,
        places=_PLACES,
        at_a_time=True,
        odds=lacking(possible="thermal level"),
        reference="Incropera and DeWitt, Fundamentals of Heat and Mass Transfer, ch. 5",
    ),
    EffectKind(
        name="environment.measured_input",
        words=("another input", "a recorded column acts on the plant"),
        equation="gain (column - reference), or behind a lag",
        parameters=(
            Quantity(name="gain", unit="", role="amplitude", sign="real"),
            Quantity(name="reference", unit="", role="shape", sign="real", neutral=0.0),
            Quantity(name="time_constant", unit="s", role="time"),
        ),
        sought="equations",
        in_equations=InEquations(
            acts="anywhere",
            text="gain*(memory - reference)",
            memory=(("memory", "(column - memory)/time_constant"),),
            at_once="gain*(column - reference)",
            unless="time_constant",
            trials=_column_trials,
            spread={"reference": lambda s: s.column},
            plainer=_without_lag,
        ),
        reference=_LJUNG,
    ),
)
