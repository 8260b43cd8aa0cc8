"""Effects in words: what each one is, as a sentence that a stranger understands, and a few words for a diagram."""

from __future__ import annotations

import math
from collections.abc import Mapping

from autotune.models import Parameter

#: By name: a few words, and a sentence's main clause.
WORDS: Mapping[str, tuple[str, str]] = {
    "actuator.saturation": ("limits", "the actuator gives no more beyond its limits"),
    "actuator.dead_zone": ("dead zone", "small commands do nothing"),
    "actuator.rate_limit": ("rate limit", "the actuator moves no faster than a limit"),
    "actuator.backlash": ("play", "the actuator has play and follows late after every reversal"),
    "actuator.stiction": ("stiction", "the actuator sticks, then jumps"),
    "actuator.lag": ("a lag", "the command passes a lag that the model does not have"),
    "actuator.asymmetric_lag": ("uneven lag", "the actuator is slower one way than the other"),
    "actuator.nonlinear_gain": ("curved gain", "the actuator's gain changes with the command"),
    "actuator.offset": ("offset", "the command's operating point is another one"),
    "actuator.gain_drift": ("drifting gain", "the actuator's gain drifts with time"),
    "actuator.quantisation": ("steps", "the command reaches the plant in steps"),
    "plant.coulomb_friction": ("dry friction", "dry friction opposes the motion, whatever the speed"),
    "plant.stribeck_friction": ("friction at rest", "friction is larger at rest than in motion"),
    "plant.viscous_friction": ("friction", "friction grows with the speed"),
    "plant.quadratic_drag": ("drag", "drag grows with the square of the speed"),
    "plant.cubic_stiffness": ("curved spring", "the spring's stiffness changes with the travel"),
    "plant.position_dependent_gain": ("gain over position", "the plant's gain changes along its travel"),
    "plant.hard_stop": ("a stop", "the travel ends at a stop"),
    "plant.sqrt_outflow": ("root outflow", "the outflow grows with the root of the level"),
    "plant.resonance": ("resonance", "the plant resonates, which the model does not"),
    "plant.hysteresis": ("hysteresis", "the force depends on the way that the position came"),
    "plant.radiation_loss": ("radiation", "heat is lost by radiation, with the fourth power of the temperature"),
    "plant.nonlinear_loss": ("growing loss", "the loss grows faster than the difference that drives it"),
    "plant.leak": ("leak", "the plant loses what it has stored"),
    "plant.sine_torque": ("periodic force", "a force repeats over the position, as gravity does on an arm"),
    "plant.slow_mode": ("slow mode", "a second, slow mode follows behind the first"),
    "sensor.saturation": ("sensor limits", "the sensor reads no further than its limits"),
    "sensor.lag": ("a lag", "the reading passes a lag that the model does not have"),
    "sensor.quantisation": ("steps", "the reading comes in steps"),
    "sensor.nonlinear_gain": ("curved sensor", "the sensor's gain changes with what it reads"),
    "sensor.absolute_value": ("no sign", "the sensor cannot tell the sign"),
    "sensor.drift": ("drift", "the reading drifts with time"),
    "sensor.dropout": ("missing samples", "samples are missing and the last reading is repeated"),
    "sensor.outliers": ("outliers", "single readings are far off"),
    "timing.dead_time": ("dead time", "the command acts later than the model says"),
    "timing.jitter": ("jitter", "samples are not taken when their stamps say"),
    "timing.clock_error": ("clock error", "the clock of the stamps runs at another rate"),
    "environment.step_load": ("a load", "a load comes at a time and stays"),
    "environment.periodic_load": ("periodic load", "a load swings at a frequency of its own"),
    "environment.drifting_load": ("drifting load", "a load grows with time"),
    "environment.gain_step": ("a switched gain", "from a time on a command does more, or less, than before"),
    "environment.loss_step": ("a switched loss", "from a time on the plant loses more, or less, of what it has stored"),
    "environment.measured_input": ("another input", "a recorded column acts on the plant"),
    "controller.law": ("control law", "the command was computed by another law than the stated one"),
}


def in_short(name: str) -> str:
    """Return an effect in a few words; its own name where there are none."""
    return WORDS[name][0] if name in WORDS else name.rpartition(".")[2].replace("_", " ")


def clause(name: str) -> str:
    """Return what an effect is, as a clause that begins with a small letter."""
    return WORDS[name][1] if name in WORDS else f"there is {in_short(name)}"


def joined(clauses: list[str]) -> str:
    """Return clauses as one: commas, and ``and`` before the last."""
    if len(clauses) < 2:
        return "".join(clauses)
    return f"{', '.join(clauses[:-1])} and {clauses[-1]}"


def sentence(text: str) -> str:
    """Return a clause as a sentence."""
    return f"{text[:1].upper()}{text[1:]}."


def number(value: float, digits: int = 4) -> str:
    """Return a number to some digits, without an exponent where a person reads it more easily so."""
    if not math.isfinite(value) or value == 0.0 or not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits}g}"
    decimals = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def unit_of(unit: str) -> str:
    """Return a unit as it stands after a number: nothing where there is none."""
    unit = unit.replace("-/s", "1/s") if unit.startswith("-/") else unit
    return "" if unit in ("-", "") else f" {unit}"


def with_spread(p: Parameter, digits: int = 4) -> str:
    """Return a parameter with its 95 % interval, where that is known, and its unit."""
    spread = f" ± {number(1.96 * p.sd, 2)}" if math.isfinite(p.sd) else ""
    return f"{number(p.value, digits)}{spread}{unit_of(p.unit)}"


def of_candidate(name: str) -> str:
    """Return a hypothesis in words, its effects' names in brackets."""
    if name in ("none", "unknown"):
        return {"none": "nothing is missing", "unknown": "a cause outside the catalogue"}[name]
    return joined([clause(one) for one in name.split("+")]) + f" ({name.replace('+', ' + ')})"
