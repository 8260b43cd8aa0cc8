"""Free-run simulation of a model with its effects: the chain assembled once, then driven by recordings."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from autotune.arrays import FloatArray, IntArray
from autotune.diagnosis import kernel
from autotune.diagnosis.catalogue import CATALOGUE, STRUCTURES, Entry, Quantity
from autotune.diagnosis.chain import Chain, chain_of
from autotune.errors import InputError
from autotune.models import Block, Effect, Model, TransferFunction
from autotune.recording import Recording

#: Effects that lie in the samples or the law alone: they leave the simulation as it is.
SAMPLE_EFFECTS = ("sensor.dropout", "sensor.outliers", "timing.jitter", "controller.law")
_STEPPED = {kernel.COULOMB: 2, kernel.STOP_LOW: 2, kernel.STOP_HIGH: 2, kernel.A_RATE: 4, kernel.A_FALL: 2}


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulator:
    """An assembled model, ready to be driven.

    Attributes
    ----------
    chain : Chain
        Linear chain, blocks that effects add included.
    E, on : (SLOTS,) array
        Effect parameters of the compiled simulation, and which act.
    forced : bool
        Whether an effect acts as a force.
    u_offset, y_offset : float
        Operating point.
    linear_hold : bool
        Whether u runs straight between rows.
    falling : Chain
        The chain while the actuator falls; the same object where its lag does not depend on the direction.
    """

    chain: Chain
    E: FloatArray
    on: IntArray
    forced: bool
    u_offset: float
    y_offset: float
    linear_hold: bool
    falling: Chain

    def step_s(self, dt_s: float) -> float:
        """Return the longest sub-step [s] for a sample time: shorter where forces change within a sample."""
        pieces = 4 if self.linear_hold else 1
        if self.forced:
            pieces = max(pieces, math.ceil(self.chain.fastest_of_plant * dt_s / 0.2))
        for slot, least in _STEPPED.items():
            if self.on[slot]:
                pieces = max(pieces, least)
        return dt_s / min(pieces, 8)

    def run(
        self,
        recording: Recording,
        x0: FloatArray,
        starts: IntArray | None = None,
        number: int = 0,
        ends: FloatArray | None = None,
        stops: IntArray | None = None,
        sample_time_s: float | None = None,
        signals: int = kernel.SIGNALS,
    ) -> FloatArray:
        """Simulate a recording's rows.

        Parameters
        ----------
        recording : Recording
            Its t and u drive the chain.
        x0 : (W, n) array
            State at each window's first row.
        starts : (W,) int array, optional
            Rows where windows start; the first row alone by default.
        number : int
            The recording's number among those diagnosed.
        ends : (W, n) array, optional
            Receives the state that every window ends with.
        stops : (W,) int array, optional
            Rows before which the windows end; the next window's start by default.
        sample_time_s : float, optional
            The recording's, where it is known already.
        signals : int
            How many signals are asked for: all, or 1 for the reading alone.

        Returns
        -------
        (N, signals) array
            Reading, speed, position (or level) and plant input at each row; NaN outside the windows.
        """
        dt = recording.sample_time_s if sample_time_s is None else sample_time_s
        step = self.step_s(dt)
        rising, falling = _table(self.chain, step), _table(self.falling, step)
        out = np.full((signals, len(recording)), np.nan)
        rows = np.zeros(1, dtype=np.int64) if starts is None else starts
        states = np.atleast_2d(x0)
        until = np.append(rows[1:], len(recording)) if stops is None else stops
        end_states = np.empty_like(states) if ends is None else ends
        kernel.run(
            recording.t, recording.u, self.linear_hold, rows, until, states, number, self.chain.delay_s,
            self.u_offset, self.y_offset, rising, falling, step, self.chain.taps, self.chain.gains, self.chain.where,
            self.E, self.on, int(self.forced), out, end_states,
        )  # fmt: skip
        return out.T

    def rest_state(self, u: float, y: float) -> FloatArray:
        """Return the state nearest to rest under a command that gives a reading.

        Parameters
        ----------
        u, y : float
            Command and reading, absolute.

        Returns
        -------
        (n,) array
            For an integrating chain at rest but for its reading; else the linear equilibrium, shifted to the reading.
        """
        chain = self.chain
        n = chain.order
        aim = y - self.y_offset
        # least squares of: A x = -B w (weighted), output = aim
        weight = 1e3
        scale = np.maximum(np.abs(chain.A).max(axis=1), 1e-12)
        lhs = np.vstack([chain.A / scale[:, None], weight * chain.taps[kernel.OUTPUT]])
        rhs = np.append(-chain.B[:, 0] / scale * (u - self.u_offset), weight * aim)
        state = np.linalg.lstsq(lhs, rhs, rcond=1e-12)[0]
        return np.asarray(state).reshape(n)


@lru_cache(maxsize=64)
def _table(chain: Chain, step_s: float) -> FloatArray:
    """Return a chain's transitions for a step: the same for all recordings, and for all effects that add no block."""
    return np.asarray(kernel.transition_table(chain.A, chain.B, step_s))


def assemble(model: Model) -> Simulator:
    """Assemble a model with its effects for simulation.

    Parameters
    ----------
    model : Model
        Chain and effects.

    Returns
    -------
    Simulator
        What runs it.

    Raises
    ------
    InputError
        An effect that is not in the catalogue, lacks a parameter, or does not fit the chain.
    """
    E, on = np.zeros(kernel.SLOTS), np.zeros(kernel.SLOTS, dtype=np.int64)
    E[kernel.STEP_END], E[kernel.STEP_RECORDING] = np.inf, -1.0
    blocks = model.blocks
    fall: tuple[Block, ...] | None = None
    u_offset = model.input.offset
    forced = False
    for effect in model.effects:
        if effect.name in SAMPLE_EFFECTS:
            continue
        entry = entry_of(effect.name, model.name)
        forced |= entry.forced
        match effect.name:
            case "actuator.lag" | "sensor.lag":
                blocks = _with_lag(blocks, entry.place, _value(effect, "time_constant", model.name))
            case "actuator.asymmetric_lag":
                fall = _actuator_lag(blocks, _value(effect, "time_constant_down", model.name))
                blocks = _actuator_lag(blocks, _value(effect, "time_constant_up", model.name))
                on[kernel.A_FALL] = 1
            case "plant.resonance":
                blocks = _with_resonance(blocks, effect, model.name)
            case "plant.slow_mode":
                blocks = _with_slow_mode(blocks, effect, model.name)
            case "timing.dead_time":
                blocks = _with_delay(blocks, _value(effect, "delay", model.name))
            case "actuator.offset":
                u_offset -= _value(effect, "offset", model.name)
            case _:
                _fill_slots(entry, effect, E, on, model)
    chain = chain_of(blocks, model.name)
    falling = chain if fall is None else chain_of(fall, model.name)
    _check(chain, E, on, model)
    return Simulator(
        chain=chain,
        E=E,
        on=on,
        forced=forced,
        u_offset=u_offset,
        y_offset=model.output.offset,
        linear_hold=model.input.hold == "linear",
        falling=falling,
    )


_OFFSET = Entry(
    name="actuator.offset",
    equation="w = u - u0 + offset",
    parameters=(Quantity(name="offset", unit="{u}", scale="real"),),
    starts=lambda s: [],
    same=("environment.step_load",),
    places=("actuator", "environment", "plant"),
    reference="Astrom and Hagglund, Advanced PID Control, 2006, ch. 9",
)


def entry_of(name: str, where: str = "catalogue") -> Entry:
    """Return the catalogue's entry of an effect.

    Raises
    ------
    InputError
        No effect of that name.
    """
    if name == "actuator.offset":
        return _OFFSET
    if name in STRUCTURES:
        return STRUCTURES[name]
    if name not in CATALOGUE:
        raise InputError(f"effect {name!r} cannot be simulated", where=where, remedy="use a name of the catalogue")
    return CATALOGUE[name]


def _value(effect: Effect, key: str, where: str) -> float:
    if key not in effect.parameters:
        raise InputError(f"{effect.name} lacks {key}", where=where, remedy=f"add {key} to its parameters")
    return effect.parameters[key].value


def _fill_slots(entry: Entry, effect: Effect, E: FloatArray, on: IntArray, model: Model) -> None:
    slots = {q.name: q.slot for q in entry.parameters}
    optional = {"operating_level_2": kernel.SQRT_2, "slip": kernel.A_SLIP}
    for key, parameter in effect.parameters.items():
        slot = slots.get(key, optional.get(key, -1))
        if slot < 0:
            known = f"known: {', '.join(slots)}"
            raise InputError(f"{effect.name} has no parameter {key!r}", where=model.name, remedy=known)
        E[slot], on[slot] = parameter.value, 1
    if not on[[slot for slot in slots.values() if slot >= 0]].any() and slots:
        raise InputError(f"{effect.name} has no parameters", where=model.name, remedy=f"known: {', '.join(slots)}")
    if effect.name == "plant.radiation_loss":
        celsius = "c" in model.output.unit.lower()
        E[kernel.RADIATION_ZERO] = model.output.offset + (273.15 if celsius else 0.0)


def _check(chain: Chain, E: FloatArray, on: IntArray, model: Model) -> None:
    """Refuse effects that the chain has no place for, and values that make no sense."""
    if (on[kernel.COULOMB] or on[kernel.DRAG] or on[kernel.CUBIC]) and not chain.is_mechanical:
        raise InputError("friction, drag and stiffness need a speed and a position", where=model.name)
    if (on[kernel.STOP_LOW] or on[kernel.STOP_HIGH]) and chain.where[kernel.I_POSITION] < 0:
        raise InputError("a hard stop needs a position that is a state", where=model.name)
    if on[kernel.A_FALL] and chain.where[kernel.I_ACTUATOR] < 0:
        raise InputError("an asymmetric lag needs an actuator of first order", where=model.name)
    positive = (kernel.A_QUANTUM, kernel.S_QUANTUM, kernel.STRIBECK_SPEED, kernel.SQRT_1, kernel.SQRT_2,
                kernel.HYSTERESIS_WIDTH, kernel.SINE_PERIOD)  # fmt: skip
    for slot in positive:
        if on[slot] and not E[slot] > 0.0:
            raise InputError("steps, widths, periods and levels of effects are positive", where=model.name)
    if on[kernel.RADIATION] and not E[kernel.RADIATION_ZERO] > 0.0:
        raise InputError("radiation needs a positive absolute temperature", where=model.name)


def _with_lag(blocks: tuple[Block, ...], place: str, time_constant: float) -> tuple[Block, ...]:
    lag = TransferFunction(num=(1.0,), den=(max(time_constant, 1e-12), 1.0))
    if place == "actuator":
        return (Block(name="added lag", place="actuator", dynamics=lag), *blocks)
    return (*blocks, Block(name="added lag", place="sensor", dynamics=lag))


def _with_resonance(blocks: tuple[Block, ...], effect: Effect, where: str) -> tuple[Block, ...]:
    omega = 2.0 * math.pi * _value(effect, "frequency", where)
    den = (1.0 / omega**2, 2.0 * _value(effect, "damping", where) / omega, 1.0)
    mode = Block(name="resonance", place="sensor", dynamics=TransferFunction(num=(1.0,), den=den))
    return (*blocks, mode)


def _with_slow_mode(blocks: tuple[Block, ...], effect: Effect, where: str) -> tuple[Block, ...]:
    T, share = _value(effect, "time_constant", where), _value(effect, "share", where)
    lag = TransferFunction(num=((1.0 - share) * T, 1.0), den=(T, 1.0))
    return (*blocks, Block(name="slow mode", place="sensor", dynamics=lag))


def _with_delay(blocks: tuple[Block, ...], delay_s: float) -> tuple[Block, ...]:
    first = blocks[0]
    total = first.dynamics.delay_s + delay_s
    if total < 0.0:
        raise InputError("the dead time is negative", where="timing.dead_time")
    return (replace(first, dynamics=replace(first.dynamics, delay_s=total)), *blocks[1:])


def _actuator_lag(blocks: tuple[Block, ...], time_constant: float) -> tuple[Block, ...]:
    """Give the first actuator lag a time constant, or put one in front."""
    for i, block in enumerate(blocks):
        if block.place == "actuator" and len(block.dynamics.den) == 2 and block.dynamics.den[1] != 0.0:
            gain = block.dynamics.num[-1] / block.dynamics.den[1]
            lag = TransferFunction(num=(gain,), den=(time_constant, 1.0), delay_s=block.dynamics.delay_s)
            return (*blocks[:i], replace(block, dynamics=lag), *blocks[i + 1 :])
    return _with_lag(blocks, "actuator", time_constant)
