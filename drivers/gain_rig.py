"""A rig behind a register map whose own controller's gains are in the map too, in whatever form its maker has."""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from autotune.config.registers import GainSettings, RegisterMap, UnlockSettings
from autotune.controller import PIDController
from autotune.errors import InputError, LinkError
from autotune.experiment.rig import Reading
from drivers.gain_settings import controller_of, settings_of
from drivers.kinds import Session
from drivers.register_link import RegisterLink
from drivers.register_rig import RegisterRig
from drivers.registers import Codec, blocks

#: steps of a register, relative to what it holds, that are fine enough for a gain
_FINE = 0.01
#: signals without which the device's own controller cannot be tried: to start it, and to see what it does
_TRIAL = ("automatic", "setpoint", "u_applied")
#: relative difference between what was written to that controller and what is held, which is the device's own rounding
_ROUNDED = 1e-3


class GainRegisterRig(RegisterRig):
    """A device whose own PI or PID is in the register map as well; parameters as of :class:`RegisterRig`.

    Raises
    ------
    InputError
        No gains are mapped.
    """

    def __init__(self, link: RegisterLink, registers: RegisterMap, **settings: Any) -> None:
        super().__init__(link, registers, **settings)
        held = registers.held_gains
        if held is None:
            raise InputError("no gains are mapped", where="rig.registers", remedy="map K and Ti, or gains")
        self._gains: GainSettings = held
        self._unlock: UnlockSettings | None = registers.unlock
        self._gain_names = registers.gain_names
        self._parts = blocks([self._codecs[name] for name in self._gain_names.values()])
        self._asked: dict[
            str, float
        ] = {}  # what the controller on trial was asked for, as its registers should hold it

    def read_gains(self) -> PIDController:
        """Return the gains the device's controller holds now."""
        self._link.connect()
        return self._decode_gains([list(self._link.read(block).words) for block in self._parts])

    def holdable(self, controller: PIDController) -> PIDController:
        """Return the controller that the device would hold after these gains were written: rounded to its registers.

        Raises
        ------
        InputError
            A gain does not fit its register, or the device has no setting for what the controller needs.
        DesignError
            The device's form cannot express the controller.
        """
        held = self._decode_gains(self._encode_gains(controller))
        if not self.takes_weight:  # a weight of the set-point leaves feedback and margins alone
            held = replace(held, setpoint_weight=controller.setpoint_weight)
        return held

    @property
    def takes_weight(self) -> bool:
        """Whether a weight of the set-point can be written."""
        return "PWeighting" in self._gains.settings

    def coarse(self, controller: PIDController) -> tuple[str, ...]:
        """Return which registers move a setting by more than half a percent, each with a scale that would not."""
        told = []
        for name, value in settings_of(self._gains, controller).items():
            codec = self._codecs[self._gain_names[name]]
            held = codec.decode(codec.encode(value))
            if codec.resolution > 0.0 and abs(held - value) > 0.5 * _FINE * abs(value):
                told.append(
                    f"rig.registers.{codec.name} holds {held:.4g} for {value:.4g}: scale = {_round(_FINE * value):g}"
                    f" in place of {abs(codec.register.scale):g} would do"
                )
        return tuple(told)

    def write_gains(self, controller: PIDController) -> None:
        """Write gains and read them back; where that fails the old ones are written again.

        The dead-man is fed meanwhile where the host commands.

        Raises
        ------
        InputError
            The device's form has no place for the controller, or a gain does not fit its register; nothing was written.
        LinkError
            What is read back differs, or the link broke; says what the device holds, as far as it is known.
        """
        new = self._encode_gains(controller)
        self._link.connect()
        old = [list(self._link.read(block).words) for block in self._parts]
        try:
            self._write_checked(new)
        except LinkError as error:
            raise self._restore_gains(old, error) from None

    @property
    def not_startable(self) -> str:
        """Which signals are not mapped that the trial of the device's own controller needs; empty where all are."""
        lacking = [name for name in _TRIAL if name not in self._codecs]
        return f"{' and '.join(lacking)} {'is' if len(lacking) == 1 else 'are'} not mapped" if lacking else ""

    @property
    def guards_trial(self) -> bool:
        """Whether the device takes its safe output where the host falls silent while its controller is on trial."""
        return "trial" in self._codecs

    @property
    def takes_load(self) -> bool:
        """Whether a load can be added to the output of the device's own controller."""
        return "load" in self._codecs

    @property
    def scan_time_s(self) -> float:
        """Cycle of the device's program [s]; 20 ms where the configuration does not say it."""
        return self._scan_s

    def start_controller(self, setpoint: float) -> float:
        """Give the actuator to the device's own controller, at a set-point, and go on with reading.

        Parameters
        ----------
        setpoint : float
            Where it is to hold y [y unit].

        Returns
        -------
        float
            The set-point as the register holds it [y unit].

        Raises
        ------
        InputError
            The register map lacks what this needs; nothing was done.
        LinkError
            The host does not command.
        """
        if self.not_startable:
            remedy = " and ".join(f"rig.registers.{name}" for name in _TRIAL)
            raise InputError(self.not_startable, where=self._link.where, remedy=f"map {remedy}")
        self._require(self._is_commanding, "the host is not in command", "open the rig first")
        self._release(setpoint, on_trial=True)
        self._trial_setpoint = setpoint
        self._is_commanding, self._released_s = False, self._clock.now()
        asked = {"automatic": 1.0, "trial": 1.0, "setpoint": self._round("setpoint", setpoint), "load": 0.0}
        # a device that refuses to say what it was asked for is not looked at
        self._asked = {
            name: value
            for name, value in asked.items()
            if name in self._codecs and math.isfinite(self._read_back(name))
        }
        self._looks_s = self._clock.now()
        return asked["setpoint"]

    def take_command(self) -> None:
        """Take the actuator back from the device's own controller, and hold the output that it applied last.

        Nothing where the host has it already. ``trial`` stays: gains that are in the device are still on trial.

        Raises
        ------
        LinkError
            The device does not let the host command.
        """
        if self._is_commanding:
            return
        self._require(self._is_released, "the host did not give the actuator away", "open the rig first")
        self._released_s = math.nan
        self._take(self._sample()[0].u_applied, was_automatic=True)

    def ask_controller(self, setpoint: float, load: float) -> tuple[float, float]:
        """Change what the device's own controller is asked for.

        Parameters
        ----------
        setpoint : float
            New set-point [y unit].
        load : float
            What is added to its output [u unit]; 0 where the register map has no load.

        Returns
        -------
        setpoint, load : float
            As the registers hold them.

        Raises
        ------
        LinkError
            The controller was not asked for what was written before: another master asked it for something else.
        """
        self._check_asked()
        asked = {"setpoint": setpoint} | ({"load": load} if self.takes_load else {})
        for name, value in asked.items():
            self._put(name, value)
            if name in self._asked:
                self._asked[name] = self._round(name, value)
        return self._round("setpoint", setpoint), self._round("load", load) if self.takes_load else 0.0

    def misread(self, controller: PIDController) -> dict[str, PIDController]:
        """Return the controllers that a device holds which reads words or bytes of these gains in another order.

        Parameters
        ----------
        controller : PIDController
            Gains as they were written.

        Returns
        -------
        dict of str to PIDController
            By what is wrong, for one register after the other and for all of them; without those that change nothing.
        """
        right = self._gains_of_words(self._encode_gains(controller))
        found: dict[str, PIDController] = {}
        for order in ("word_order", "byte_order"):
            wrong = {name: self._otherwise(name, value, order) for name, value in right.items()}
            for names in (*((name,) for name in right), tuple(right)):
                shown = right | {name: wrong[name] for name in names}
                if shown == right or not all(math.isfinite(value) for value in shown.values()):
                    continue
                which = "all gains" if len(names) > 1 else f"rig.registers.{names[0]}"
                with contextlib.suppress(ArithmeticError, InputError):  # what the form cannot say
                    found.setdefault(f"{order} of {which}", self._controller(shown))
        return found

    def misread_setpoint(self, setpoint: float) -> dict[str, float]:
        """Return the set-points that a device has which reads words or bytes in another order [y unit]."""
        right = self._round("setpoint", setpoint)
        orders = ("word_order", "byte_order")
        wrong = {f"{order} of rig.registers.setpoint": self._otherwise("setpoint", right, order) for order in orders}
        return {name: value for name, value in wrong.items() if math.isfinite(value) and value != right}

    def _look_for_master(self, reading: Reading) -> Reading:
        """Look now and then whether the controller on trial is still asked for what the host wrote, too."""
        if self._is_released and self._may_look(reading, on_slow_line=self._takes_over):
            self._check_asked()
        return super()._look_for_master(reading)

    def _check_asked(self) -> None:
        """Refuse to go on with a trial in which somebody else asks the controller for something."""
        start_s = self._clock.now()
        shown = self._read(tuple(self._asked))
        self._has_looked(start_s)
        for name, value in self._asked.items():
            is_own = math.isclose(shown[name], value, rel_tol=_ROUNDED)
            if not is_own and name == "setpoint" and self._takes_over:  # in manual it may have followed y
                self._put(name, value)
                continue
            self._require(
                is_own,
                f"another master writes {name}, or the device's own program does: it holds {shown[name]:.6g} at"
                f" {start_s - self._opened_s:.3g} s of this session, {value:.6g} was written",
                "have nobody else write it while the controller is on trial",
            )

    def _round(self, name: str, value: float) -> float:
        """Return what a register holds of a value."""
        return self._codecs[name].decode(self._codecs[name].encode(value))

    def _otherwise(self, name: str, value: float, order: str) -> float:
        """Return the value as a device reads it that has words or bytes in the other order."""
        codec = self._codecs[name]
        other = "big" if getattr(codec.register, order) == "little" else "little"
        return Codec(name=name, register=codec.register.model_copy(update={order: other})).decode(codec.encode(value))

    def _encode_gains(self, controller: PIDController) -> list[list[int]]:
        """Return the words of every block of gains."""
        values = {self._gain_names[name]: value for name, value in settings_of(self._gains, controller).items()}
        return [
            [word for codec, _ in block.parts for word in codec.encode(values[codec.name])] for block in self._parts
        ]

    def _decode_gains(self, words: Sequence[list[int]]) -> PIDController:
        return self._controller(self._gains_of_words(words))

    def _gains_of_words(self, words: Sequence[list[int]]) -> dict[str, float]:
        """Return the engineering values of the words of every block of gains."""
        shown: dict[str, float] = {}
        for block, held in zip(self._parts, words, strict=True):
            shown |= block.decode(held)
        return shown

    def _controller(self, shown: Mapping[str, float]) -> PIDController:
        return controller_of(self._gains, {name: shown[mapped] for name, mapped in self._gain_names.items()})

    def _write_checked(self, words: Sequence[list[int]]) -> None:
        self._key(self._unlock.code if self._unlock is not None else None)
        for block, wanted in zip(self._parts, words, strict=True):
            self.feed()
            self._link.write(block.table, block.address, wanted)
        for block, wanted in zip(self._parts, words, strict=True):
            self.feed()
            held = list(self._link.read(block).words)
            if held != wanted:
                raise LinkError(f"read back {held} where {wanted} was written", where=self._link.where)
        self._key(self._unlock.lock if self._unlock is not None else None)

    def _key(self, code: int | None) -> None:
        """Write a code into the register that locks and unlocks the device, where there is one."""
        if self._unlock is not None and code is not None:
            words = Codec(name="unlock", register=self._unlock).encode(float(code))
            self._link.write(self._unlock.table, self._unlock.address, words)

    def _restore_gains(self, old: Sequence[list[int]], cause: LinkError) -> LinkError:
        """Write the old gains again and return the error that says how it ended."""
        try:
            self._link.disconnect()
            self._link.connect()
            self._write_checked(old)
        except LinkError:
            state, remedy = "the device may hold old, new or mixed gains", "stop it and check its gains before it runs"
        else:
            state, remedy = "the device holds its old gains again", cause.remedy
        return LinkError(f"the gains were not taken ({cause.what}); {state}", where=self._link.where, remedy=remedy)


class TypedGainRig(GainRegisterRig):
    """A device whose protocol says in which order words and bytes travel; parameters as of :class:`RegisterRig`."""

    def misread(self, controller: PIDController) -> dict[str, PIDController]:
        """Return nothing: a value has one reading."""
        return {}

    def misread_setpoint(self, setpoint: float) -> dict[str, float]:
        """Return nothing: a value has one reading."""
        return {}


class RegisterSection(Protocol):
    """What the settings of every rig behind registers, nodes or data blocks have."""

    feed_s: float
    scan_time_s: float | None

    @property
    def registers(self) -> RegisterMap:
        """The map."""
        ...


def open_registers(
    link: RegisterLink, settings: RegisterSection, session: Session, with_gains: type[GainRegisterRig], **more: Any
) -> RegisterRig:
    """Return the rig behind a link, with its own controller's gains where they are mapped.

    Parameters
    ----------
    link : RegisterLink
        To the device, not yet connected.
    settings : RegisterSection
        Of the rig.
    session : Session
        Limits and safe output.
    with_gains : type
        What the rig is where gains are mapped.
    **more
        Further settings of the rig, as ``permissives``.
    """
    kind = RegisterRig if settings.registers.held_gains is None else with_gains
    return kind(
        link,
        settings.registers,
        u_range=session.u_range,
        u_safe=session.u_safe,
        feed_s=settings.feed_s,
        scan_time_s=settings.scan_time_s,
        **more,
    )


def _round(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above the magnitude."""
    value = max(abs(value), sys.float_info.min)  # a hundredth of the smallest gain there is may be none
    power = 10.0 ** math.floor(math.log10(value))
    # half of it too: the logarithm of just less than a power of ten rounds to that of the power
    return max(step * power for step in (0.5, 1.0, 2.0, 5.0) if step * power <= value)
