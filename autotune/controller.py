"""Controllers as people write them down: PI and PID in the ISA standard form, or a transfer function.

The controller file is TOML: ``kind = "pi"`` with ``K`` and ``Ti_s`` (u = K (1 + 1/(Ti s)) e), ``kind = "pid"`` with
``Td_s`` and ``Tf_s`` besides, or ``num`` and ``den`` in descending powers of s, or with ``sample_time_s`` in ascending
powers of the delay operator. K carries the sign: a negative gain belongs to a plant with negative gain.
"""

from __future__ import annotations

import math
import os
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import tomli_w

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import InputError
from autotune.models import TransferFunction


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
    """

    K: float
    Ti_s: float
    Td_s: float = 0.0
    Tf_s: float = 0.0
    setpoint_weight: float = 1.0

    @property
    def kind(self) -> Literal["pi", "pid"]:
        """``pi`` where there is neither derivative action nor filter."""
        return "pi" if self.Td_s == 0.0 and self.Tf_s == 0.0 else "pid"

    def transfer_function(self) -> TransferFunction:
        """Return C(s) as a transfer function."""
        if math.isinf(self.Ti_s):
            return TransferFunction(num=(self.K * self.Td_s, self.K), den=(self.Tf_s, 1.0))
        gain = self.K / self.Ti_s
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


def read_controller(path: str | os.PathLike[str]) -> Controller:
    """Read a controller file.

    Raises
    ------
    InputError
        No such file, not TOML, or keys that make no controller; names the key.
    """
    where = str(path)
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=where, remedy="check the path") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"not TOML: {error}", where=where) from None
    if "num" in content:
        return _rational(content, where)
    kind = str(content.get("kind", "")).lower()
    if kind not in ("pi", "pid"):
        raise InputError(
            f"kind = {content.get('kind')!r}", where=where, remedy='write kind = "pi" or "pid", or num and den'
        )
    number = {
        key: _number(content, key, where, default)
        for key, default in (
            ("K", None),
            ("Ti_s", None),
            ("Td_s", 0.0),
            ("Tf_s", 0.0),
            ("setpoint_weight", 1.0),
        )
    }
    if not number["Ti_s"] > 0:
        raise InputError(f"Ti_s = {number['Ti_s']:g}", where=where, remedy="the integral time is a positive time in s")
    if number["Td_s"] < 0 or number["Tf_s"] < 0:
        raise InputError("Td_s and Tf_s", where=where, remedy="times are not negative")
    return PIDController(**number)


def _number(content: dict[str, Any], key: str, where: str, default: float | None) -> float:
    value = content.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        raise InputError(f"{key} = {value!r}", where=where, remedy=f"write {key} as a number")
    return float(value)


def _rational(content: dict[str, Any], where: str) -> Controller:
    try:
        num = tuple(float(value) for value in content["num"])
        den = tuple(float(value) for value in content["den"])
    except (KeyError, TypeError, ValueError):
        raise InputError("num and den must be lists of numbers", where=where) from None
    if "sample_time_s" not in content:
        return TransferFunction(num=num, den=den)
    sample_time_s = _number(content, "sample_time_s", where, None)
    if not sample_time_s > 0 or not den or den[0] == 0.0:
        raise InputError("sample_time_s must be positive and den begin with a value other than 0", where=where)
    return DiscreteController(
        num=tuple(b / den[0] for b in num), den=tuple(a / den[0] for a in den), sample_time_s=sample_time_s
    )


def write_controller(controller: Controller, path: str | os.PathLike[str]) -> None:
    """Write a controller file that :func:`read_controller` reads back to an equal controller."""
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
    Path(path).write_bytes(tomli_w.dumps(content).encode())
