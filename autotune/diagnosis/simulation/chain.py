"""The linear chain in state space, arranged so that physics can be put into it.

Every first-order block's state is its output, so that speed, position and level are states; blocks of higher order
are in controllable form, the first state in the unit of the output. Positions and levels are in the unit of the
reading, whatever gain the sensor has. Forces enter at the input of the first plant block, in that input's unit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from autotune.arrays import FloatArray, IntArray
from autotune.diagnosis.simulation import kernel
from autotune.errors import InputError
from autotune.models import Block, Model, TransferFunction, law_of

#: Positions in a chain's ``where``.
ACTUATOR, SPEED, POSITION = range(3)


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """State space of a chain with its signals.

    Attributes
    ----------
    A : (n, n) array
        Dynamics.
    B : (n, 3) array
        Columns: command, force at the first plant block's input, input of the last plant block.
    taps : (5, n) array
        Rows: plant input, speed, position (or level), output, first level.
    gains : (4,) array
        Gain of the first plant block from force to speed or level, of the last plant block, direct gain from command
        to plant input and from command to output.
    where : (3,) int array
        State numbers of actuator lag (in the command's unit), speed and position, -1 where there is none.
    levels : int
        Number of levels, one above the other; 0 where the plant has a speed.
    delay_s : float
        Dead time of all blocks together, which commutes with the linear chain.
    plant : slice
        The states of the plant's blocks.
    is_static : bool
        Whether the plant is a law without dynamics, as a damper's force over its speed.
    """

    A: FloatArray
    B: FloatArray
    taps: FloatArray
    gains: FloatArray
    where: IntArray
    levels: int
    delay_s: float
    plant: slice
    is_static: bool = False

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @cached_property
    def fastest_of_plant(self) -> float:
        """Largest rate of the plant's own poles [rad/s]."""
        return float(np.max(np.abs(np.linalg.eigvals(self.A[self.plant, self.plant]))))

    @property
    def has_actuator_lag(self) -> bool:
        """Whether an actuator's first-order lag stands before the plant."""
        return bool(self.where[ACTUATOR] >= 0)

    @property
    def has_position_state(self) -> bool:
        """Whether the position or level is itself a state."""
        return bool(self.where[POSITION] >= 0)

    @property
    def is_mechanical(self) -> bool:
        """Whether the plant has a speed."""
        return bool(self.taps[kernel.SPEED].any())

    @property
    def has_travel(self) -> bool:
        """Whether it has a position beside its speed."""
        return self.is_mechanical and bool((self.taps[kernel.POSITION] != self.taps[kernel.SPEED]).any())

    @property
    def has_spring(self) -> bool:
        """Whether a spring, or gravity, pulls the position back: the plant settles."""
        return self.has_travel and not self.is_integrating

    @property
    def is_integrating(self) -> bool:
        """Whether the chain has a pole at the origin."""
        poles = np.abs(np.linalg.eigvals(self.A))
        return bool(np.min(poles) <= 1e-9 * np.max(poles)) if self.order else False


def _realise(block: Block) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return A, b, c, d of one block."""
    if len(block.dynamics.den) == 2 >= len(block.dynamics.num):
        return _realise_first_order(block.dynamics)
    den = np.asarray(block.dynamics.den) / block.dynamics.den[0]
    num = np.zeros(den.size)
    num[den.size - len(block.dynamics.num) :] = np.asarray(block.dynamics.num) / block.dynamics.den[0]
    n = den.size - 1
    direct = float(num[0])
    c = (num[1:] - direct * den[1:])[::-1]
    A = np.zeros((n, n))
    b = np.zeros(n)
    if n:
        A[:-1, 1:] = np.eye(n - 1)
        A[-1] = -den[:0:-1]
        # a stop holds a state where readings say: the first state is the output, and not this over the gain
        b[-1] = c[0] if c[0] != 0.0 else 1.0
        c = c / b[-1]
    return A, b, c, direct


def _realise_first_order(dynamics: TransferFunction) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the same of a block of first order, whose state is its output; a fit builds hundreds of thousands."""
    lead, last = dynamics.den
    rate = last / lead
    direct = dynamics.num[0] / lead if len(dynamics.num) == 2 else 0.0
    return np.array([[-rate]]), np.array([dynamics.num[-1] / lead - direct * rate]), np.array([1.0]), direct


def build_chain(model: Model) -> Chain:
    """Arrange a model's blocks in state space, see :func:`chain_of`; its effects are not looked at."""
    return chain_of(with_unit(model.blocks, model.output.unit), model.name)


def with_unit(blocks: tuple[Block, ...], unit: str) -> tuple[Block, ...]:
    """Return blocks, the last one with the unit of the measurement where it has none of its own."""
    last = blocks[-1]
    return blocks if last.unit or last.output or not unit else (*blocks[:-1], replace(last, unit=unit))


@lru_cache(maxsize=64)
def chain_of(blocks: tuple[Block, ...], name: str) -> Chain:
    """Arrange blocks in state space; a fit asks for the same ones again and again.

    Parameters
    ----------
    blocks : tuple of Block
        The chain.
    name : str
        The model's name, for errors.

    Returns
    -------
    Chain
        State space with taps.

    Raises
    ------
    InputError
        A chain without any dynamics, or of more than 12 states.
    """
    order = sum(len(block.dynamics.den) - 1 for block in blocks)
    if not 1 <= order <= 12:
        raise InputError(f"the chain has {order} states", where=name, remedy="diagnosis handles 1 to 12 states")
    plant, law = _plant_blocks(blocks), law_of(blocks)
    blocks = blocks if law is not None else _in_readings(blocks, plant)
    A, B = np.zeros((order, order)), np.zeros((order, kernel.INPUTS))
    signals, edges = _arranged(blocks, plant, law, A, B)
    taps = signals.taps
    if law is not None:
        taps[[kernel.SPEED, kernel.POSITION, kernel.FIRST_LEVEL]], signals.where[:] = 0.0, -1
    return Chain(
        A=A,
        B=B,
        taps=taps,
        gains=signals.gains,
        where=signals.where,
        levels=0 if taps[kernel.SPEED].any() else len(plant),
        delay_s=sum(block.dynamics.delay_s for block in blocks),
        plant=slice(*edges),
        is_static=law is not None,
    )


def _arranged(
    blocks: Sequence[Block], plant: Sequence[int], law: int | None, A: FloatArray, B: FloatArray
) -> tuple[_Signals, tuple[int, int]]:
    """Fill in A and B block by block; return where signals are read, and the first of the plant's states and the next.

    ``row`` and ``direct`` are how the present block's input follows from states and inputs of the chain.
    """
    order = A.shape[0]
    signals = _Signals(
        taps=np.zeros((5, order)), gains=np.array([1.0, 1.0, 0.0, 0.0]), where=np.full(3, -1, dtype=np.int64)
    )
    taps, gains = signals.taps, signals.gains
    row, direct, at, edges = np.zeros(order), np.array([1.0, 0.0, 0.0]), 0, (order, 0)
    commanded = 1.0  # gain from the command to the present block's input, at rest
    for number, block in enumerate(blocks):
        a, b, c, d = _realise(block)
        n = b.size
        rests = -b[0] / a[0, 0] * commanded if n == 1 and a[0, 0] != 0.0 else 0.0
        if block.place == "actuator" and rests != 0.0 and number < plant[0]:
            # which way a lag goes is told by the command beside its state: both in the command's unit; others too, or
            # their states would change with a lag that an effect puts in front of them
            b, c = b / rests, c * rests
            if signals.where[ACTUATOR] < 0:
                signals.where[ACTUATOR] = at
        commanded *= _gain(block) if block.dynamics.den[-1] != 0.0 else 0.0
        if number == plant[0]:
            taps[kernel.PLANT_IN], gains[2] = row, direct[0]
            direct[1] = 1.0
        if number == plant[-1] and number != plant[0]:
            direct[2] = 1.0
        before, states = (row, direct[0]), slice(at, at + n)
        if n:
            A[states, states] = a
            A[states] += b[:, None] * row
            B[states] += b[:, None] * direct
        row = d * row
        row[states] += c
        direct = d * direct
        if number in plant:
            _note_signals(signals, block, (number == plant[0], number == plant[-1]), at, c, row)
            edges = (min(edges[0], at), at + n)
        at += n
        if number == law:
            taps[kernel.PLANT_IN], gains[2] = before
    taps[kernel.OUTPUT], gains[3] = row, direct[0]
    return signals, edges


def _plant_blocks(blocks: Sequence[Block]) -> list[int]:
    """Return the numbers of the plant's dynamic blocks; without any, of the slowest block."""
    dynamic = [i for i, b in enumerate(blocks) if len(b.dynamics.den) > 1]
    plant = [i for i in dynamic if blocks[i].place == "plant"]
    if len(plant) == 1 and plant[0] - 1 in dynamic and _integrates(blocks[plant[0]]) and blocks[plant[0] - 1].is_speed:
        return [plant[0] - 1, *plant]  # the speed of what integrates, wherever its block is said to be

    def slowness(i: int) -> float:
        den = blocks[i].dynamics.den
        return float("inf") if den[-1] == 0.0 else abs(den[0] / den[-1]) ** (1.0 / (len(den) - 1))

    return plant or [max(dynamic, key=slowness)]


def _in_readings(blocks: tuple[Block, ...], plant: Sequence[int]) -> tuple[Block, ...]:
    """Return blocks whose gains behind a plant's states are in front of them; the chain from end to end is the same.

    The last state, a position or level, is in the reading's unit then, and a speed is what the position changes by.
    """
    first, last = plant[0], plant[-1]
    behind = math.prod(_gain(block) for block in blocks[last + 1 :])
    speed = first != last and _integrates(blocks[last])
    within = math.prod(_gain(block) for block in blocks[first + 1 : last + 1]) if speed else 1.0
    if behind * within == 0.0:
        return blocks
    moved = list(blocks)
    for at, gain in ((first if speed else last, behind * within), (last, 1.0 / within), (last + 1, 1.0 / behind)):
        if gain != 1.0:
            dynamics = moved[at].dynamics
            moved[at] = replace(moved[at], dynamics=replace(dynamics, num=tuple(gain * c for c in dynamics.num)))
    return tuple(moved)


def _gain(block: Block) -> float:
    """Return the gain of a block at rest, of an integrator that of its rate."""
    return block.dynamics.num[-1] / block.dynamics.settling_den[-1]


def _integrates(block: Block) -> bool:
    return len(block.dynamics.den) == 2 and block.dynamics.den[-1] == 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class _Signals:
    """Where signals are read, filled in block by block."""

    taps: FloatArray
    gains: FloatArray
    where: IntArray


def _note_signals(
    signals: _Signals, block: Block, ends: tuple[bool, bool], at: int, c: FloatArray, row: FloatArray
) -> None:
    """Note which states of a plant's block are speed, position and level, and the gain from force to them.

    ``ends`` says whether it is the plant's first block and its last one.
    """
    (first, last), (taps, gains, where) = ends, (signals.taps, signals.gains, signals.where)
    den, n = block.dynamics.den, c.size
    # of what integrates, the gain to what it integrates: to the speed, written as one block or as two
    static = _gain(block) or 1.0  # a plant without static gain, as a derivative: forces count as they come out
    if first:
        gains[0] = static
        taps[kernel.FIRST_LEVEL] = row
        if n == 1 and last and block.is_speed:
            taps[kernel.SPEED], where[SPEED] = row, at
        if n == 2 and last and c[0] != 0.0 and not block.is_stored:
            taps[kernel.SPEED, at + 1] = c[0]
            where[SPEED] = at + 1
            where[POSITION] = at
            taps[kernel.POSITION, at] = c[0]
            return
    if last:
        gains[1] = static
        taps[kernel.POSITION] = row
        where[POSITION] = at if n == 1 else -1
        if not first and n == 1 and den[-1] == 0.0:
            taps[kernel.SPEED] = taps[kernel.FIRST_LEVEL]
            where[SPEED] = at - 1
