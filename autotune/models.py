"""Models: transfer functions with exact dead time, and the chain of blocks that a person believes the rig to be.

The model file is TOML: ``[input]``, ``[output]``, a ``[[block]]`` for every link of the chain, ``[[effect]]`` tables
where a diagnosis added physics. ``y = last block's output + output.offset``, driven by ``u - input.offset``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np

from autotune.arrays import ComplexArray, FloatArray, is_real
from autotune.errors import InputError

Place: TypeAlias = Literal["actuator", "plant", "sensor"]
#: What a speed is called, and its units.
_SPEED = re.compile(r"speed|velocity|\brpm\b")
_SPEED_UNIT = re.compile(r"^(m|mm|cm|km|rad|deg|°|rev|turns?)/(s|min|h)$|^rpm$|^1/min$")
#: Units of temperatures, and what is heated or filled is called.
TEMPERATURE_UNITS = ("degc", "\N{DEGREE SIGN}c", "k", "degf", "c", "celsius")
HEATED, FILLED = re.compile(r"temperature|heater|heated|oven|furnace"), re.compile(r"\btanks?\b|\blevel\b")
Hold: TypeAlias = Literal["zero", "linear"]

#: Most blocks of a chain and most coefficients of a polynomial: far beyond any plant, far before work becomes a wait.
MOST_BLOCKS, MOST_COEFFICIENTS = 50, 40
#: Largest size of a number in a model file; where arithmetic overflows, a result would be none.
LARGEST = 1e30
#: Smallest size other than 0.
SMALLEST = 1e-30


def _trim(coefficients: Sequence[float]) -> tuple[float, ...]:
    values = [float(value) for value in coefficients]
    while len(values) > 1 and values[0] == 0.0:
        values.pop(0)
    return tuple(values)


@dataclass(frozen=True, kw_only=True)
class TransferFunction:
    """num(s)/den(s) exp(-s delay): rational with an exact dead time.

    Attributes
    ----------
    num, den : tuple of float
        Coefficients in descending powers of s; leading zeros are dropped.
    delay_s : float
        Dead time [s], evaluated exactly as exp(-j omega L), never by a Pade approximation.

    Raises
    ------
    InputError
        A denominator that is zero, coefficients that are not finite, or a negative dead time.
    """

    num: tuple[float, ...]
    den: tuple[float, ...]
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        lists = all(isinstance(one, tuple | list | np.ndarray) and len(one) for one in (self.num, self.den))
        if not lists or not all(is_real(v) and math.isfinite(v) for v in (*self.num, *self.den, self.delay_s)):
            raise InputError("num, den and delay must be finite numbers", where="transfer function")
        object.__setattr__(self, "num", _trim(self.num))
        object.__setattr__(self, "den", _trim(self.den))
        if self.den == (0.0,):
            raise InputError("the denominator is zero", where="transfer function")
        if self.delay_s < 0.0:
            raise InputError(f"delay = {self.delay_s:g} s is negative", where="transfer function")

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return the complex gain at the angular frequencies, same shape as ``omega_rad_s``."""
        s = 1j * np.asarray(omega_rad_s, dtype=np.float64)
        rational = np.polyval(self.num, s) / np.polyval(self.den, s)
        return np.asarray(rational * np.exp(-s * self.delay_s), dtype=np.complex128)

    def __mul__(self, other: TransferFunction) -> TransferFunction:
        return TransferFunction(
            num=tuple(np.polymul(self.num, other.num)),
            den=tuple(np.polymul(self.den, other.den)),
            delay_s=self.delay_s + other.delay_s,
        )

    @property
    def poles(self) -> ComplexArray:
        """Roots of the denominator [rad/s]."""
        return np.asarray(np.roots(self.den), dtype=np.complex128)

    @property
    def zeros(self) -> ComplexArray:
        """Roots of the numerator [rad/s]."""
        return np.asarray(np.roots(self.num), dtype=np.complex128)

    @property
    def settling_den(self) -> tuple[float, ...]:
        """Denominator without its integrators: without the coefficients after the last one that is not 0."""
        return self.den[: max(j for j, c in enumerate(self.den) if c != 0.0) + 1]

    @property
    def integrators(self) -> int:
        """Number of poles at s = 0 that the numerator does not cancel."""

        def at_origin(coefficients: tuple[float, ...]) -> int:
            return len(coefficients) - len(np.trim_zeros(np.array(coefficients), "b"))

        return max(0, at_origin(self.den) - at_origin(self.num))

    @property
    def is_proper(self) -> bool:
        """Whether the numerator's degree is at most the denominator's."""
        return len(self.num) <= len(self.den)


@dataclass(frozen=True, kw_only=True)
class Port:
    """The chain's input or output.

    Attributes
    ----------
    unit : str
        Unit of the signal.
    offset : float
        Operating point.
    hold : {"zero", "linear"}
        At the input, how u runs between samples.
    recorded : (float, float), optional
        Lowest and highest value of the recordings that the model was fitted to: its range of validity. Beyond it laws
        are extrapolated.
    """

    unit: str = ""
    offset: float = 0.0
    hold: Hold = "zero"
    recorded: tuple[float, float] | None = None

    def beyond(self, values: FloatArray) -> tuple[float, float]:
        """Return how far values leave the recorded range, in its spans, and which share of them does; 0 without one."""
        if self.recorded is None or not np.isfinite(values).any():
            return 0.0, 0.0
        low, high = self.recorded
        known = values[np.isfinite(values)]
        slack = np.maximum(low - known, known - high)
        span = max(high - low, 1e-9 * max(abs(low), abs(high)), 1e-300)
        return max(float(np.max(slack)) / span, 0.0), float(np.mean(slack > 0.0))


@dataclass(frozen=True, kw_only=True)
class Block:
    """One link of the chain.

    Attributes
    ----------
    name : str
        What it is, in the reader's terms.
    place : {"actuator", "plant", "sensor"}
        Where in the rig it sits.
    dynamics : TransferFunction
        Proper transfer function with its dead time.
    output, unit : str
        Name and unit of the block's output signal, empty where not given.
    """

    name: str
    place: Place
    dynamics: TransferFunction
    output: str = ""
    unit: str = ""

    @property
    def is_speed(self) -> bool:
        """Whether the output of a first-order block is a speed, by its name or unit."""
        said = f"{self.name} {self.output}".lower()
        return len(self.dynamics.den) == 2 and bool(_SPEED.search(said) or _SPEED_UNIT.search(self.unit.lower()))

    @property
    def is_stored(self) -> bool:
        """Whether the output is what is stored, heat or a level, by its unit or name: nothing moves there."""
        said = f"{self.name} {self.output}".lower()
        return self.unit.strip().lower() in TEMPERATURE_UNITS or bool(HEATED.search(said) or FILLED.search(said))


def law_of(blocks: Sequence[Block]) -> int | None:
    """Return the number of the plant's block where the plant is a law without dynamics."""
    plant = [i for i, b in enumerate(blocks) if b.place == "plant"]
    return plant[0] if plant and all(len(blocks[i].dynamics.den) == 1 for i in plant) else None


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A value with its standard deviation and unit; the standard deviation is NaN where it is not known."""

    value: float
    unit: str = ""
    sd: float = float("nan")

    def __eq__(self, other: object) -> bool:
        """Whether value, unit and standard deviation are the same; two that are not known are."""
        if not isinstance(other, Parameter):
            return NotImplemented
        unknown = math.isnan(self.sd) and math.isnan(other.sd)
        return (self.value, self.unit) == (other.value, other.unit) and (unknown or self.sd == other.sd)

    def __hash__(self) -> int:
        """Return the hash of value and unit: that of a NaN differs from one object to the next."""
        return hash((self.value, self.unit))


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Physics added to a model: an entry ``PLACE.EFFECT`` of the catalogue, where it acts, its parameters.

    Attributes
    ----------
    name, at : str
        The catalogue's name, and where in a chain it acts.
    parameters : mapping of str to Parameter
        Its parameters.
    state, input, port, column : str
        The state, input, port or recorded column that it acts on, in models of equations or with several inputs.
    """

    name: str
    at: str = ""
    parameters: Mapping[str, Parameter] = field(default_factory=lambda: MappingProxyType({}))
    state: str = ""
    input: str = ""
    port: str = ""
    column: str = ""

    @property
    def values(self) -> dict[str, float]:
        """Its parameters as numbers."""
        return {key: q.value for key, q in self.parameters.items()}

    def with_values(self, values: Mapping[str, float]) -> Effect:
        """Return it with other values of some parameters, whose units and standard deviations stay."""
        if not values:
            return self
        new = {key: replace(self.parameters[key], value=value) for key, value in values.items()}
        return replace(self, parameters=MappingProxyType({**self.parameters, **new}))


@dataclass(frozen=True, kw_only=True)
class Model:
    """A chain of blocks in series, with the effects that were added to it."""

    name: str
    input: Port
    output: Port
    blocks: tuple[Block, ...]
    effects: tuple[Effect, ...] = ()

    def transfer_function(self) -> TransferFunction:
        """Return the product of the blocks: the small-signal model, without the effects."""
        product = TransferFunction(num=(1.0,), den=(1.0,))
        for block in self.blocks:
            product = product * block.dynamics
        return product

    @property
    def delay_s(self) -> float:
        """Dead time from the command to the reading, of all blocks together [s]."""
        return sum(block.dynamics.delay_s for block in self.blocks)

    @property
    def signal_units(self) -> dict[str, str]:
        """Units of a recording's u and y."""
        return {"u": self.input.unit, "y": self.output.unit}

    @property
    def plant_input_unit(self) -> str:
        """Unit of the plant's input: an actuator's output as far as one is stated, else the command's."""
        return next((b.unit for b in self.blocks if b.place == "actuator" and b.unit), self.input.unit)

    @property
    def force_unit(self) -> str:
        """Unit of the plant's forces: of its input, or of the reading where the plant is a law without dynamics."""
        return self.plant_input_unit if law_of(self.blocks) is None else self.output.unit

    @property
    def speed_unit(self) -> str:
        """Unit of the plant's speed: the reading's own where a speed is read, empty where it has none."""
        unit = self.output.unit
        plant = [b for b in self.blocks if b.place == "plant" and len(b.dynamics.den) > 1]
        is_read = bool(_SPEED_UNIT.search(unit.lower())) or (plant != [] and plant[-1].is_speed)
        return unit if is_read or not unit else f"{unit}/s"

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return the complex gain from u to y, effects left out, same shape as ``omega_rad_s``."""
        product = np.ones_like(np.asarray(omega_rad_s), dtype=np.complex128)
        for block in self.blocks:
            product = product * block.dynamics.response(omega_rad_s)
        return product
