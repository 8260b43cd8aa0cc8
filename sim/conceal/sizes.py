"""Equations' parameters of every effect at a size: a pure number that the search for a strength turns.

A size of 1 only has to be a sensible start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sim.conceal.physics import Physics


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Sizes of the rig's signals without any effect, and units: what the effects are measured in."""

    du: float
    dy: float
    v: float
    length: float
    Ts: float
    noise: float
    unit_u: str
    unit_y: str


@dataclass(frozen=True, kw_only=True)
class Sized:
    """An effect at one size: fields of the physics that change, row errors, law changes, and true parameters."""

    physics: dict[str, float] = field(default_factory=dict)
    jitter: float = 0.0
    lost: float = 0.0
    lost_rows: float = 0.0
    spikes: float = 0.0
    spike_size: float = 0.0
    law: dict[str, float] = field(default_factory=dict)
    parameters: dict[str, tuple[float, str]] = field(default_factory=dict)


Maker = Callable[[float, Physics, Scale, np.random.Generator], Sized]


def _plain(**fields: Callable[[float, Physics, Scale], float]) -> Callable[..., Maker]:
    """Effect whose fields need no random choice; the parameters come from ``says``."""

    def with_words(says: Callable[[dict[str, float], Physics, Scale], dict[str, tuple[float, str]]]) -> Maker:
        def make(size: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
            values = {name: float(rule(size, p, s)) for name, rule in fields.items()}
            return Sized(physics=values, parameters=says(values, p, s))

        return make

    return with_words


# ----- actuator -----
saturation = _plain(command_limit=lambda a, p, s: 1.8 * s.du / a)(
    lambda f, p, s: {
        "lower": (p.u_offset - f["command_limit"], s.unit_u),
        "upper": (p.u_offset + f["command_limit"], s.unit_u),
    }
)
dead_zone = _plain(dead_zone=lambda a, p, s: 0.2 * a * s.du)(lambda f, p, s: {"half_width": (f["dead_zone"], s.unit_u)})
rate_limit = _plain(rate_limit=lambda a, p, s: 2.0 * s.du / (a * p.tau_actuator))(
    lambda f, p, s: {"rate": (f["rate_limit"], f"{s.unit_u}/s")}
)
backlash = _plain(backlash=lambda a, p, s: 0.2 * a * s.du)(lambda f, p, s: {"half_width": (f["backlash"], s.unit_u)})
stiction = _plain(stiction=lambda a, p, s: 0.2 * a * s.du)(lambda f, p, s: {"band": (f["stiction"], s.unit_u)})
actuator_lag = _plain(extra_lag=lambda a, p, s: 0.15 * a * p.tau_plant)(
    lambda f, p, s: {"time_constant": (f["extra_lag"], "s")}
)


def asymmetric_lag(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal an actuator lag with one time constant while its output rises and another while it falls."""
    slow = p.tau_actuator * (1.0 + 0.5 * a)
    factor = slow / p.tau_actuator
    if rng.random() < 0.5:
        parameters = {"time_constant_up": (slow, "s"), "time_constant_down": (p.tau_actuator, "s")}
        return Sized(physics={"lag_rising_factor": factor}, parameters=parameters)
    parameters = {"time_constant_up": (p.tau_actuator, "s"), "time_constant_down": (slow, "s")}
    return Sized(physics={"tau_actuator": slow, "lag_rising_factor": 1.0 / factor}, parameters=parameters)


def actuator_gain(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a static actuator gain: e = du + c du^2."""
    c = float(rng.choice([-1.0, 1.0])) * 0.08 * a / s.du
    return Sized(physics={"command_second_order": c}, parameters={"second_order": (c, f"1/{s.unit_u}")})


def gain_drift(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal an actuator gain that changes with time: 1 + rate t."""
    rate = float(rng.choice([-0.4, 0.6])) * min(a, 2.0) / s.length
    return Sized(physics={"gain_rate": rate}, parameters={"rate": (rate, "1/s")})


def command_quantum(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a converter's step; one of its levels is the operating point or zero."""
    step = 0.5 * a * s.du
    origin = -p.u_offset if rng.random() < 0.5 else 0.0
    fields = {"command_quantum": step, "quantum_origin": origin}
    return Sized(physics=fields, parameters={"step": (step, s.unit_u)})


# ----- plant -----
def _level(f: float, p: Physics, s: Scale) -> dict[str, tuple[float, str]]:
    return {"level": (f, s.unit_u), "level_as_speed": (f * abs(p.K), f"{s.unit_y}/s")}


coulomb = _plain(coulomb=lambda a, p, s: 0.1 * a * s.du, breakaway=lambda a, p, s: 0.1 * a * s.du)(
    lambda f, p, s: _level(f["coulomb"], p, s)
)


def stribeck(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal dry friction Fc + (Fs - Fc) exp(-(v/vs)^2), opposing the motion, sticking up to Fs."""
    coulomb, ratio, speed = 0.1 * a * s.du, float(rng.uniform(1.5, 2.5)), float(rng.uniform(0.1, 0.4)) * s.v
    parameters = {
        **_level(coulomb, p, s),
        "breakaway": (coulomb * ratio, s.unit_u),
        "stribeck_speed": (speed, f"{s.unit_y}/s"),
    }
    fields = {"coulomb": coulomb, "breakaway": coulomb * ratio, "stribeck_speed": speed}
    return Sized(physics=fields, parameters=parameters)


drag = _plain(drag=lambda a, p, s: 0.2 * a / s.v)(lambda f, p, s: {"coefficient": (f["drag"], f"s/{s.unit_y}")})
cubic = _plain(cubic=lambda a, p, s: 0.05 * a * s.du / s.dy**3)(
    lambda f, p, s: {"coefficient": (f["cubic"], f"{s.unit_u}/{s.unit_y}^3")}
)


def position_gain(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal an actuator effect scaled with position: 1 + slope x."""
    slope = float(rng.choice([-1.0, 1.0])) * 0.1 * a / s.dy
    return Sized(physics={"gain_slope": slope}, parameters={"slope": (slope, f"1/{s.unit_y}")})


def hard_stop(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal an inelastic stop on one side."""
    side = 1.0 if rng.random() < 0.7 else -1.0
    stop = side * 1.7 * s.dy / a
    fields = {"stop": stop, "stop_sign": side}
    return Sized(physics=fields, parameters={"position": (p.y_offset + stop, s.unit_y)})


sqrt_outflow = _plain(head=lambda a, p, s: max(5.0 * s.dy / a, 1.2 * s.dy))(
    lambda f, p, s: {"head_at_operating_point": (f["head"], s.unit_y)}
)
radiation = _plain(
    absolute_temperature=lambda a, p, s: p.y_offset + 273.15,
    radiation=lambda a, p, s: 0.1 * a / (4.0 * (p.y_offset + 273.15) ** 3),
)(lambda f, p, s: {"coefficient": (f["radiation"], "1/K^3")})
leak = _plain(leak=lambda a, p, s: 0.05 * a / p.tau_plant)(lambda f, p, s: {"rate": (f["leak"], "1/s")})


def resonance(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a lightly damped second-order mode in series with the output."""
    omega, damping = 6.0 / (p.tau_plant * a), float(rng.uniform(0.03, 0.15))
    parameters = {"frequency": (omega / (2.0 * np.pi), "Hz"), "damping_ratio": (damping, "-")}
    return Sized(physics={"flex_omega": omega, "flex_damping": damping}, parameters=parameters)


def hysteresis(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal Dahl friction: level z, dz/dt = (v - |v| z) / displacement."""
    level, displacement = 0.1 * a * s.du, float(rng.uniform(0.15, 0.5)) * s.dy
    parameters = {"level": (level, s.unit_u), "displacement": (displacement, s.unit_y)}
    return Sized(physics={"preslide_level": level, "preslide_displacement": displacement}, parameters=parameters)


def sine_torque(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a load periodic in position: level sin(2 pi x / period + phase)."""
    period = float(rng.uniform(1.5, 4.0)) * s.dy
    wave, phase = 2.0 * np.pi / period, float(rng.uniform(0.0, 6.28))
    fields = {"torque": 0.15 * a * s.du, "torque_wave_number": wave, "torque_phase": phase}
    parameters = {"level": (0.15 * a * s.du, s.unit_u), "period": (period, s.unit_y), "phase": (phase, "rad")}
    return Sized(physics=fields, parameters=parameters)


# ----- sensor -----
def sensor_high(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal an upper end of the sensor (before its noise) or of its converter (after it)."""
    level = 1.7 * s.dy / a
    name = str(rng.choice(["sensor_high", "reading_high"]))
    return Sized(physics={name: level}, parameters={"upper": (p.y_offset + level, s.unit_y)})


sensor_lag = _plain(extra_sensor_lag=lambda a, p, s: 0.15 * a * p.tau_plant)(
    lambda f, p, s: {"time_constant": (f["extra_sensor_lag"], "s")}
)
sensor_quantum = _plain(sensor_quantum=lambda a, p, s: 2.0 * a * s.noise)(
    lambda f, p, s: {"step": (f["sensor_quantum"], s.unit_y)}
)


def sensor_gain(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a static sensor gain: y + c y^2 about the output offset."""
    c = float(rng.choice([-1.0, 1.0])) * 0.04 * a / s.dy
    return Sized(physics={"sensor_second_order": c}, parameters={"second_order": (c, f"1/{s.unit_y}")})


fold = _plain(sensor_fold=lambda a, p, s: -1.8 * s.dy / a)(
    lambda f, p, s: {"fold": (p.y_offset + f["sensor_fold"], s.unit_y)}
)


def sensor_drift(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a sensor reading that wanders off at a constant rate."""
    rate = float(rng.choice([-1.0, 1.0])) * a * s.noise / s.length
    return Sized(physics={"sensor_rate": rate}, parameters={"rate": (rate, f"{s.unit_y}/s")})


def dropout(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal runs of rows in which the last measurement stays."""
    share, rows = min(0.02 * a, 0.3), float(rng.integers(3, 15))
    return Sized(lost=share / rows, lost_rows=rows, parameters={"share": (share, "-"), "rows": (rows, "-")})


def outliers(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal single rows with a spike of either sign."""
    size = float(rng.uniform(6.0, 15.0)) * s.noise
    share = min(0.02 * a**2 * (s.noise / size) ** 2 * 50.0, 0.2)
    return Sized(spikes=share, spike_size=size, parameters={"share": (share, "-"), "size": (size, s.unit_y)})


# ----- timing, environment, controller -----
dead_time = _plain(delay=lambda a, p, s: p.delay + 0.1 * a * p.tau_plant)(
    lambda f, p, s: {"dead_time": (f["delay"], "s")}
)


def jitter(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal rows taken early or late by a random time, with even time stamps."""
    sd = min(0.15 * a, 0.45) * s.Ts
    return Sized(jitter=sd, parameters={"sd": (sd, "s")})


clock = _plain(clock_error=lambda a, p, s: 0.1 * a * p.tau_plant / s.length)(
    lambda f, p, s: {"relative": (f["clock_error"], "-")}
)
offset = _plain(command_offset=lambda a, p, s: 0.2 * a * s.du)(
    lambda f, p, s: {"offset": (f["command_offset"], s.unit_u)}
)


def load_step(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a load that begins at some time and stays."""
    size = float(rng.choice([-1.0, 1.0])) * 0.1 * a * s.du
    start = round(float(rng.uniform(0.25, 0.6)) * s.length / s.Ts) * s.Ts
    fields = {"load_step": size, "load_start": start}
    return Sized(physics=fields, parameters={"size": (size, s.unit_u), "time": (start, "s")})


def periodic_load(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a sinusoidal load."""
    amplitude, hertz = 0.1 * a * s.du, float(rng.uniform(0.08, 0.4)) / p.tau_plant
    fields = {"load_amplitude": amplitude, "load_hertz": hertz, "load_phase": float(rng.uniform(0.0, 6.28))}
    return Sized(physics=fields, parameters={"amplitude": (amplitude, s.unit_u), "frequency": (hertz, "Hz")})


def drifting_load(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a load that grows at a constant rate."""
    rate = float(rng.choice([-1.0, 1.0])) * 0.1 * a * s.du / s.length
    return Sized(physics={"load_rate": rate}, parameters={"rate": (rate, f"{s.unit_u}/s")})


def law(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a controller whose gain or integral time is not the stated one."""
    which = str(rng.choice(["K", "T_I"]))
    factor = float((1.0 + 0.35 * a) ** rng.choice([-1.0, 1.0]))
    return Sized(law={which: factor}, parameters={f"{which}_factor": (factor, "-")})


# ----- beyond any catalogue -----
def echo(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a sensor that also hears its own past: y + g y(t - d)."""
    gain, delay = min(0.1 * a, 0.5), float(rng.uniform(0.6, 2.0)) * p.tau_plant
    return Sized(
        physics={"echo_gain": gain, "echo_delay": delay}, parameters={"gain": (gain, "-"), "delay": (delay, "s")}
    )


def switching(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a plant gain that alternates between two values."""
    gain, period = float(rng.choice([-0.3, 0.4])) * min(a, 2.5), s.length / float(rng.uniform(4.0, 9.0))
    parameters = {"change": (gain, "-"), "period": (period, "s")}
    return Sized(physics={"switching_gain": gain, "switching_period": period}, parameters=parameters)


def modulate(name: str, top: float) -> Maker:
    """Conceal a lag, delay or stiffness that swings slowly in time."""

    def make(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
        reference = {"modulated_lag": 1.0, "modulated_delay": p.tau_plant, "modulated_stiffness": s.du / s.dy}[name]
        depth, hertz = min(0.2 * a, top) * reference, float(rng.uniform(0.03, 0.12)) / p.tau_plant
        fields = {name: depth, "modulation_hertz": hertz}
        if name == "modulated_delay":
            fields["delay"] = p.delay + depth
        return Sized(physics=fields, parameters={"depth": (depth, "-"), "frequency": (hertz, "Hz")})

    return make


crosstalk = _plain(crosstalk=lambda a, p, s: 3.0 * a * s.noise / s.du)(
    lambda f, p, s: {"gain": (f["crosstalk"], f"{s.unit_y}/{s.unit_u}")}
)


def creep(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal creep: part of the output follows with a long time constant."""
    fraction, tau = min(0.15 * a, 0.7), float(rng.uniform(3.0, 8.0)) * p.tau_plant
    parameters = {"fraction": (fraction, "-"), "time_constant": (tau, "s")}
    return Sized(physics={"creep_fraction": fraction, "creep_time": tau}, parameters=parameters)


def chirp(a: float, p: Physics, s: Scale, rng: np.random.Generator) -> Sized:
    """Conceal a load whose frequency sweeps."""
    low = 0.05 / p.tau_plant
    fields = {"load_amplitude": 0.15 * a * s.du, "load_hertz": low, "load_chirp": 0.3 / p.tau_plant / s.length}
    return Sized(physics=fields, parameters={"amplitude": (0.15 * a * s.du, s.unit_u), "from": (low, "Hz")})
