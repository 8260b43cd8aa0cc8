"""Rigs behind a Siemens CPU: how they are opened, what has to be there, what can be read first."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from autotune.config.s7 import SIZES, S7Settings, S7Signal, S7Type
from autotune.config.signal_map import SAMPLE
from autotune.errors import LinkError
from autotune.experiment.rig import Rig
from drivers.gain_rig import TypedGainRig, open_registers
from drivers.kinds import Reach, Session, not_installed
from drivers.pace import tell_pace
from drivers.probe import ProbedDevice, ProbedSignal
from drivers.registers import Codec, blocks, codecs
from drivers.s7_errors import RUN

if TYPE_CHECKING:
    from drivers.s7 import S7Link

#: types that a value of so many bytes may have been meant as
_ALIKE: dict[int, tuple[S7Type, ...]] = {
    1: (), 2: ("INT", "WORD"), 4: ("REAL", "DINT", "TIME"), 8: ("LREAL", "LINT")
}  # fmt: skip
#: a float below is likelier a whole number that was read as one
_LEAST = 1e-9


def _link(settings: S7Settings, *, exclusive: bool = True) -> S7Link:
    try:
        from drivers.s7 import S7Link
    except ModuleNotFoundError as error:
        raise not_installed(error, "s7") from None
    return S7Link(settings, exclusive=exclusive)


def open_kind(settings: S7Settings, session: Session) -> Rig:
    """Return the rig, with its own controller's gains where they are mapped.

    Parameters
    ----------
    settings : S7Settings
        The table ``[rig]``.
    session : Session
        What it is opened for.
    """
    return open_registers(_link(settings), settings, session, TypedGainRig)


def reach_of(settings: S7Settings) -> Reach:
    """Return the CPU's address."""
    return Reach(address=(settings.host, settings.port), timeout_s=settings.timeout_s)


def probe_kind(settings: S7Settings, expected: Mapping[str, tuple[float, float]]) -> ProbedDevice:
    """Return every mapped signal, read once; one that the CPU refuses has its refusal as a warning.

    Parameters
    ----------
    settings : S7Settings
        The table ``[rig]``.
    expected : mapping of str to (float, float)
        Range within which a signal's engineering value is plausible.
    """
    link = _link(settings, exclusive=False)
    link.connect()
    registers, signals = codecs(settings.registers.mapped()), settings.signals.mapped()
    try:
        state = link.state()
        found = [_probe_signal(link, codec, signals[name], expected.get(name)) for name, codec in registers.items()]
        refused = {one.name for one in found if math.isnan(one.value)}
        readable = [codec for name, codec in registers.items() if name in SAMPLE and name not in refused]
        pace = f"; {tell_pace(link, readable)}" if readable else ""
    finally:
        link.disconnect()
    said = "it does not say whether it runs" if state is None else f"in {'RUN' if state == RUN else 'STOP'}"
    return ProbedDevice(description=f"{link.where}, {said}{pace}", signals=tuple(found))


def _probe_signal(link: S7Link, codec: Codec, signal: S7Signal, expected: tuple[float, float] | None) -> ProbedSignal:
    try:
        words = link.read(blocks([codec])[0]).words
    except LinkError as error:
        return ProbedSignal(
            name=codec.name, raw=signal.address, value=math.nan, warnings=(f"{error.what}; {error.remedy}",)
        )
    value = codec.decode(words)
    shown = f"{signal.address} {' '.join(f'{word:04X}' for word in words)}"
    low, high = expected if expected is not None else (-math.inf, math.inf)
    if math.isfinite(value) and low <= value <= high:
        return ProbedSignal(name=codec.name, raw=shown, value=value)
    told = [f"{value:.6g}" + (f", expected {low:g}..{high:g}" if expected is not None else "")]
    for kind in _ALIKE[SIZES[signal.kind]]:
        held = signal.model_copy(update={"type": kind}).held
        other = Codec(name=codec.name, register=codec.register.model_copy(update=held._asdict())).decode(words)
        if expected is not None and kind != signal.kind and low <= other <= high and abs(other) > _LEAST:
            told.append(f'would be {other:.6g} with type = "{kind}"')
    if len(told) == 1 and expected is not None:
        told.append("check address, scale and offset")
    return ProbedSignal(name=codec.name, raw=shown, value=value, warnings=tuple(told[:3]))
