"""Controllers as people write them down: PI and PID in the ISA standard form, or a transfer function.

The controller file is TOML: ``kind = "pi"`` with ``K`` and ``Ti_s`` (u = K (1 + 1/(Ti s)) e), ``kind = "pid"`` with
``Td_s`` and ``Tf_s`` besides, or ``num`` and ``den`` in descending powers of s, or with ``sample_time_s`` in ascending
powers of the delay operator. K carries the sign: a negative gain belongs to a plant with negative gain.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import tomli_w
from pydantic import Field, field_validator, model_validator

from autotune.arrays import ComplexArray, FloatArray, is_real
from autotune.errors import InputError
from autotune.models import TransferFunction
from autotune.schema import LONGEST_S, SHORTEST_S, Number, Section, Time, shorten, validate
from autotune.text_files import check_path, read_json, read_toml
from autotune.whole_files import write_whole


@dataclass(frozen=True, kw_only=True)
class PIDController:
    """C(s) = K (1 + 1/(T_I s) + T_d s) / (1 + T_f s), equation (25) of Le & Mendes where T_d = T_f = 0.

    Attributes
    ----------
    K : float
        Proportional gain, input unit per output unit, with its sign.
    Ti_s : float
        Integral time [s]; infinite for no integral action.
    Td_s, Tf_s : float
        Derivative time and time constant of the measurement filter [s].
    setpoint_weight : float
        Share of the set-point in the proportional part, 0 to 1; it leaves feedback and margins alone.

    Raises
    ------
    InputError
        A number that is not finite, or a time that is negative or, of T_I beside a gain, 0.
    """

    K: float
    Ti_s: float
    Td_s: float = 0.0
    Tf_s: float = 0.0
    setpoint_weight: float = 1.0

    def __post_init__(self) -> None:
        for name in ("K", "Ti_s", "Td_s", "Tf_s", "setpoint_weight"):
            if not is_real(getattr(self, name)):
                raise InputError(f"{name} = {getattr(self, name)!r}"[:200], where="controller", remedy="give a number")
        if not math.isfinite(self.K):
            raise InputError(f"K = {self.K:g}", where="controller", remedy="it must be a finite number")
        if not self.Ti_s > 0.0 and self.K != 0.0:  # a device as delivered may hold zeros: there is no law in it
            remedy = "a positive time; infinite for no integral action"
            raise InputError(f"Ti_s = {self.Ti_s:g}", where="controller", remedy=remedy)
        for name, value in (("Td_s", self.Td_s), ("Tf_s", self.Tf_s), ("setpoint_weight", self.setpoint_weight)):
            if not 0.0 <= value < math.inf:
                raise InputError(f"{name} = {value:g}", where="controller", remedy="it must be finite and not negative")

    @property
    def kind(self) -> Literal["pi", "pid"]:
        """``pi`` where there is neither derivative action nor filter."""
        return "pi" if self.Td_s == 0.0 and self.Tf_s == 0.0 else "pid"

    def transfer_function(self) -> TransferFunction:
        """Return C(s) as a transfer function."""
        if math.isinf(self.Ti_s) or self.K == 0.0:
            return TransferFunction(num=(self.K * self.Td_s, self.K), den=(self.Tf_s, 1.0))
        gain = self.K / self.Ti_s
        if math.isinf(gain):
            raise InputError(f"Ti_s = {self.Ti_s:g}", where="controller", remedy="write it in other units")
        return TransferFunction(num=(gain * self.Ti_s * self.Td_s, gain * self.Ti_s, gain), den=(self.Tf_s, 1.0, 0.0))

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return C(j omega), same shape as ``omega_rad_s``."""
        return self.transfer_function().response(omega_rad_s)


@dataclass(frozen=True, kw_only=True)
class DiscreteController:
    """C(q) = (b0 + b1 q^-1 + ...) / (1 + a1 q^-1 + ...), acting on e = r - y, held between samples.

    Attributes
    ----------
    num, den : tuple of float
        Ascending powers of the delay operator.
    sample_time_s : float
        Sample time [s].
    """

    num: tuple[float, ...]
    den: tuple[float, ...]
    sample_time_s: float

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return C(exp(j omega Ts)), same shape as ``omega_rad_s``; the hold is not counted."""
        q = np.exp(-1j * np.asarray(omega_rad_s) * self.sample_time_s)
        return np.asarray(np.polyval(self.num[::-1], q) / np.polyval(self.den[::-1], q), dtype=np.complex128)


Controller: TypeAlias = PIDController | TransferFunction | DiscreteController


#: Below this size a gain commands nothing, in whatever units.
SMALLEST_GAIN = 1e-15


class _HeldPID(Section):
    """Gains that a rig was found with: numbers, whether or not they make a controller."""

    K: Annotated[Number, Field(strict=True, description="proportional gain with its sign, a number other than 0")]
    Ti_s: Annotated[
        float | None,
        Field(strict=True, allow_inf_nan=True, description="integral time [s], a positive number; inf for none"),
    ]
    Td_s: Annotated[Number, Field(strict=True, description="derivative time [s], 0 or more")] = 0.0
    Tf_s: Annotated[Number, Field(strict=True, description="time constant of the filter [s], 0 or more")] = 0.0
    setpoint_weight: Annotated[
        Number, Field(strict=True, description="share of the set-point in the proportional part, 0 to 1")
    ] = 1.0

    @field_validator("Ti_s")
    @classmethod
    def _is_number(cls, value: float | None) -> float | None:
        if value is not None and math.isnan(value):
            raise ValueError("is not a number")
        return value


class _PID(_HeldPID):
    """Keys of a PI or PID, in a controller file or a design."""

    kind: Literal["pi", "pid"] | None = None
    Td_s: Annotated[Number, Field(ge=0, strict=True, description="derivative time [s], 0 or more")] = 0.0
    Tf_s: Annotated[Number, Field(ge=0, strict=True, description="time constant of the filter [s], 0 or more")] = 0.0
    setpoint_weight: Annotated[
        float, Field(ge=0, le=1, strict=True, description="share of the set-point in the proportional part, 0 to 1")
    ] = 1.0

    @model_validator(mode="after")
    def _acts(self) -> _PID:
        if abs(self.K) < SMALLEST_GAIN:
            raise ValueError(f"K = {self.K:g} commands nothing: that is no controller")
        times = {"Ti_s": self.Ti_s, "Td_s": self.Td_s or SHORTEST_S, "Tf_s": self.Tf_s or SHORTEST_S}
        for key, value in times.items():
            endless = value is None or (key == "Ti_s" and value == math.inf)
            if value is not None and not endless and not SHORTEST_S <= value <= LONGEST_S:
                raise ValueError(f"{key} = {value!r} is no time from {SHORTEST_S:g} to {LONGEST_S:g} s")
        if self.kind == "pi" and (self.Td_s or self.Tf_s):
            raise ValueError('kind = "pi" has neither Td_s nor Tf_s; write kind = "pid"')
        return self


class _DesignedPID(_PID):
    """Keys of a design: the controller's, and what was found beside it, which is not read."""

    h2: Any = None
    h2_lower_bound: Any = None
    binding: Any = None
    margins: Any = None
    certificate: Any = None
    is_integral: Any = None


_Coefficients = Annotated[tuple[Annotated[Number, Field(strict=True)], ...], Field(min_length=1, max_length=100)]


class _Rational(Section):
    """Keys of a controller as a transfer function."""

    num: Annotated[_Coefficients, Field(strict=False, description="list of numbers")]
    den: Annotated[_Coefficients, Field(strict=False, description="list of numbers, not all 0")]
    sample_time_s: Annotated[Time | None, Field(strict=True, description="sample time [s], 1e-6 to 1e9")] = None

    @model_validator(mode="after")
    def _divides(self) -> _Rational:
        if self.sample_time_s is not None and self.den[0] == 0.0:
            raise ValueError("den must begin with a value other than 0")
        if any(0.0 < abs(value) < SMALLEST_GAIN for value in (*self.num, *self.den)):
            raise ValueError(f"a coefficient other than 0 is smaller than {SMALLEST_GAIN:g}")
        if not any(self.den):
            raise ValueError("den is zero")
        if not any(self.num):
            raise ValueError("num is zero: that is no controller")
        return self


def read_controller(path: str | os.PathLike[str]) -> Controller:
    """Read a controller: its file (TOML), or the result that it is in (JSON), or the folder of that result.

    Parameters
    ----------
    path : path
        ``controller.toml``, ``design.json``, ``result.json`` or the file of one loop of a campaign, or a folder that
        holds a ``result.json``.

    Raises
    ------
    InputError
        No such file, neither TOML nor JSON, or keys that make no controller; names the key.
    """
    where = str(check_path(path))
    if os.path.isdir(path):
        return read_controller(os.path.join(path, "result.json"))
    if os.path.splitext(path)[1].lower() == ".json":
        return read_designed(path)
    content = read_toml(path)
    if isinstance(content.get("kind"), str):
        content["kind"] = content["kind"].lower()
    if "num" in content or "den" in content:
        return _rational(content, where)
    if content.get("kind") not in ("pi", "pid"):
        kind = shorten(repr(content.get("kind")))
        raise InputError(f"kind = {kind}", where=where, remedy='write kind = "pi" or "pid", or num and den')
    return _pid(validate(_PID, content, where))


def read_designed(path: str | os.PathLike[str]) -> PIDController:
    """Return the PI or PID of a ``design.json``, of a ``result.json``, or of the file of one loop of a campaign.

    Raises
    ------
    InputError
        No such file, or no PI or PID in it that could run a loop; names the key.
    """
    table = read_json(path)
    for key in ("result", "controller"):
        table = table.get(key, table) if isinstance(table, dict) else table
    return pid_from_table(table, str(path))


def pid_from_table(table: Any, where: str) -> PIDController:
    """Return the PI or PID of a design's or a result's JSON.

    Parameters
    ----------
    table : object
        The decoded JSON.
    where : str
        Names it in messages.

    Raises
    ------
    InputError
        No gains, or gains that no controller has; names the key.
    """
    if not isinstance(table, dict) or "K" not in table or "Ti_s" not in table:
        raise InputError(
            "holds no K and Ti_s", where=where, remedy="give a design.json or the folder of a completed run"
        )
    return _pid(validate(_DesignedPID, table, where))


def read_noted_gains(table: Any, where: str) -> PIDController:
    """Return gains that were read from a rig and noted, to be written back as they were.

    A device as delivered may hold K = 0 or a negative time: they are what it held. What is not a number is refused.

    Parameters
    ----------
    table : object
        The decoded JSON.
    where : str
        Names it in messages.

    Raises
    ------
    InputError
        A gain is missing or no finite number, or there is a key besides; names it.
    """
    return _pid(validate(_HeldPID, table, where))


def _pid(given: _HeldPID) -> PIDController:
    return PIDController(
        K=given.K,
        Ti_s=math.inf if given.Ti_s is None else given.Ti_s,
        Td_s=given.Td_s,
        Tf_s=given.Tf_s,
        setpoint_weight=given.setpoint_weight,
    )


def _rational(content: dict[str, Any], where: str) -> Controller:
    given = validate(_Rational, content, where)
    if given.sample_time_s is None:
        return TransferFunction(num=given.num, den=given.den)
    return DiscreteController(
        num=tuple(b / given.den[0] for b in given.num),
        den=tuple(a / given.den[0] for a in given.den),
        sample_time_s=given.sample_time_s,
    )


def write_controller(controller: Controller, path: str | os.PathLike[str]) -> None:
    """Write a controller file that :func:`read_controller` reads back to an equal controller.

    Parameters
    ----------
    controller : Controller
        What is written.
    path : path
        The TOML file; replaced where it exists.

    Raises
    ------
    OSError
        The file cannot be written; what was there before is unchanged.
    """
    content: dict[str, Any]
    match controller:
        case PIDController():
            content = {"kind": controller.kind, "K": controller.K, "Ti_s": controller.Ti_s}
            if controller.kind == "pid":
                content |= {"Td_s": controller.Td_s, "Tf_s": controller.Tf_s}
            if controller.setpoint_weight != 1.0:
                content["setpoint_weight"] = controller.setpoint_weight
        case DiscreteController():
            content = {
                "num": list(controller.num),
                "den": list(controller.den),
                "sample_time_s": controller.sample_time_s,
            }
        case TransferFunction():
            content = {"num": list(controller.num), "den": list(controller.den)}
    write_whole(path, tomli_w.dumps(content))
