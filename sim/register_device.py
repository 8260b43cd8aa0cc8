"""A device between a register line and a plant: actuator, dead-man timer, a PI of its own. Time is told from outside.

Who moves the actuator::

    host         while ``enable`` is 1 (where it is not mapped: from the first command on); ``u`` is the output.
    controller   ``enable`` is 0 and ``automatic`` is 1: the device's PI, u = K (1 + 1/(Ti s)) (setpoint - y).
    nobody       the dead-man ran out while the host moved it, or the controller while ``trial`` is 1: the safe output;
                 ``enable`` and ``automatic`` fall to 0 and have to be set again.
    nobody       both are 0: the safe output; before the first command the output that the plant came with.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from sim.plant import Plant
from sim.registers import RegisterSpec, Table, from_words, to_words

_KEPT = 100_000
_GAINS = ("K", "Ti", "Td", "Tf")


class IllegalValue(ValueError):  # noqa: N818 - Modbus calls it so
    """A request writes what is not a finite number."""


class IllegalAddress(LookupError):  # noqa: N818 - Modbus calls it so
    """A request touches a register that the device does not have."""


@dataclass(frozen=True, kw_only=True)
class OutputChange:
    """One change of what moves the actuator.

    Attributes
    ----------
    t_s : float
        Device time [s].
    output : float
        Output from then on [u unit].
    cause : str
        ``command``, ``dead-man``, ``given back``, ``controller``.
    """

    t_s: float
    output: float
    cause: str


class RegisterDevice:
    """The device.

    Parameters
    ----------
    plant : Plant
        What it moves and measures.
    registers : mapping of str to RegisterSpec
        Signals ``y``, ``u`` and any of ``u_applied``, ``device_time``, ``heartbeat``, ``heartbeat_echo``, ``enable``,
        ``in_command``, ``safe``, ``automatic``, ``trial``, ``setpoint``, ``load``, ``K``, ``Ti``, ``Td``, ``Tf``,
        ``unlock``; others are held as they are written.
    u_safe : float
        Safe output until the host writes another [u unit].
    u_range : (float, float)
        Range of the device's PI [u unit].
    deadman_s : float
        Time without a new heartbeat (where none is mapped: without a command) until the output is safe [s].
    gains : (float, float)
        K and Ti that the device's controller is delivered with.
    held : mapping of str to float
        What further registers hold when it is delivered.
    law : callable, optional
        From all that the registers hold to K, Ti, Td, Tf of the controller, where it has its gains in another form.
    scan_s : float
        Cycle of the controller [s].
    unlock_code : float, optional
        Without it in ``unlock`` the device refuses new gains, with Modbus's illegal value.
    """

    def __init__(
        self,
        plant: Plant,
        registers: Mapping[str, RegisterSpec],
        *,
        u_safe: float,
        u_range: tuple[float, float],
        deadman_s: float = 0.5,
        gains: tuple[float, float] = (0.0, 1.0),
        held: Mapping[str, float] | None = None,
        law: Callable[[Mapping[str, float]], tuple[float, float, float, float]] | None = None,
        unlock_code: float | None = None,
        scan_s: float = 0.01,
    ) -> None:
        self.plant = plant
        self.registers = dict(registers)
        self.history: deque[OutputChange] = deque(maxlen=_KEPT)
        self.on_change: Callable[[OutputChange], None] | None = None
        self._at: dict[tuple[Table, int], list[tuple[str, int]]] = {}
        for name, spec in self.registers.items():
            for i in range(spec.size):
                there = self._at.setdefault((spec.table, spec.address + i), [])
                # an echo may be mapped onto the very register that it echoes; bits share their word
                if not there or spec.bit is not None:
                    there.append((name, i))
        self._words: dict[tuple[Table, int], int] = {}
        self._values = {
            "u": plant.u_applied,
            "safe": u_safe,
            "heartbeat": 0.0,
            "enable": 0.0,
            "automatic": 0.0,
            "trial": 0.0,
            "setpoint": 0.0,
            "load": 0.0,
            "K": gains[0],
            "Ti": gains[1],
            "Td": 0.0,
            "Tf": 0.0,
            "unlock": 0.0,
        } | dict(held or {})
        self._law = law if law is not None else _isa
        self._unlock_code = unlock_code
        self._u_range = u_range
        self._scan_s = scan_s
        self._controlled = 0.0  # what the controller asks for, without the load
        self.deadman_s = deadman_s
        self._output = plant.u_applied
        self._by_host = False
        self._fed_s = -math.inf
        self._now_s = 0.0
        self._tick_s = 0.0
        self._error = 0.0
        self._y_filtered = self._y_rate = 0.0

    @property
    def output(self) -> float:
        """What the actuator is moved with now [u unit]."""
        return self._output

    @property
    def by_host(self) -> bool:
        """Whether the host moves the actuator."""
        return self._by_host

    @property
    def value(self) -> Mapping[str, float]:
        """The values the host has written, by signal."""
        return self._values

    def show(self, name: str, value: float) -> None:
        """Have the device show a value of a signal of its own: a door, a switch.

        Parameters
        ----------
        name : str
            Of the signal.
        value : float
            In its unit.
        """
        self._values[name] = value

    def live(self, now_s: float) -> None:
        """Let the plant live until the device time ``now_s`` [s], through dead-man and controller ticks on the way."""
        while self._now_s < now_s:
            events = [now_s]
            if self._is_watched:
                events.append(self._fed_s + self.deadman_s)
            if self._is_automatic:
                events.append(self._tick_s)
            until = min(events)
            if until > self._now_s:
                self.plant.advance(self._output, until - self._now_s)
                self._now_s = until
            if self._is_watched and until >= self._fed_s + self.deadman_s:
                self._release("dead-man")
            elif self._is_automatic and until >= self._tick_s:
                self._control()

    def read(self, table: Table, address: int, count: int, now_s: float) -> list[int]:
        """Return registers; one measurement per request.

        Parameters
        ----------
        table : Table
            Which of the device's tables.
        address : int
            Of the first register.
        count : int
            How many.
        now_s : float
            The device's time [s].

        Raises
        ------
        IllegalAddress
            One of them does not exist.
        """
        places = self._places(table, address, count)
        self.live(now_s)
        # each once: a measurement must not change between its words
        names = dict.fromkeys(name for place in places for name, _ in self._at[place])
        shown = {name: to_words(self._value(name), self.registers[name]) for name in names}
        return [self._word(place, shown) for place in places]

    def write(self, table: Table, address: int, words: Sequence[int], now_s: float) -> None:
        """Take registers from the host.

        Parameters
        ----------
        table : Table
            Which of the device's tables.
        address : int
            Of the first register.
        words : sequence of int
            16 bits each.
        now_s : float
            The device's time [s].

        Raises
        ------
        IllegalAddress
            One of them does not exist, or is half of a value whose other half is not written.
        IllegalValue
            One of them is not a finite number, or the device is locked; nothing was taken.
        """
        places = self._places(table, address, len(words))
        self.live(now_s)
        written: dict[str, list[int]] = {}
        for place, word in zip(places, words, strict=True):
            for name, _ in self._at[place]:
                written.setdefault(name, []).append(word)
        if any(len(value) != self.registers[name].size for name, value in written.items()):
            raise IllegalAddress(f"{table} {address}: half a value")
        values = {name: from_words(value, self.registers[name]) for name, value in written.items()}
        if not all(math.isfinite(value) for value in values.values()):
            raise IllegalValue(f"{table} {address}: not a number")
        is_locked = self._unlock_code not in (None, self._values["unlock"])
        if is_locked and any(name in _GAINS or name.startswith("gains.") for name in values):
            raise IllegalValue(f"{table} {address}: locked")
        self._words |= dict(zip(places, words, strict=True))
        for name, taken in values.items():
            if self.registers[name].bit is None or taken != self._value(name):  # a word's other bits came along
                self._take(name, taken)

    @property
    def _is_automatic(self) -> bool:
        return not self._by_host and self._values["automatic"] == 1.0

    @property
    def _is_watched(self) -> bool:
        """Whether the dead-man ends what moves the actuator."""
        return self._by_host or (self._is_automatic and self._values["trial"] == 1.0)

    def _places(self, table: Table, address: int, count: int) -> list[tuple[Table, int]]:
        wanted = [(table, address + i) for i in range(count)]
        if not all(place in self._at for place in wanted):
            raise IllegalAddress(f"{table} {address}..{address + count - 1}")
        return wanted

    def _word(self, place: tuple[Table, int], shown: Mapping[str, list[int]]) -> int:
        """Return a register as it is shown; of a word of bits those that have no name stay as they were written."""
        word, known = 0, 0
        for name, i in self._at[place]:
            spec = self.registers[name]
            word |= shown[name][i]
            known |= (
                0xFFFF if spec.bit is None else sum(to_words(1.0, spec)[i : i + 1] + to_words(0.0, spec)[i : i + 1])
            )
        return word | self._words.get(place, 0) & ~known

    def _value(self, name: str) -> float:
        match name:
            case "y":
                return self.plant.measure()
            case "u_applied":
                return self._output
            case "device_time":
                return self._now_s
            case "heartbeat_echo":
                return self._values["heartbeat"]
            case "enable" | "in_command":
                return float(self._by_host)
        return self._values[name]

    def _take(self, name: str, value: float) -> None:
        if name == "heartbeat" and value != self._values["heartbeat"]:
            self._fed_s = self._now_s
        self._values[name] = value
        match name:
            case "u":
                if "heartbeat" not in self.registers:
                    self._fed_s = self._now_s
                if self._by_host or "enable" not in self.registers:
                    self._command()
            case "trial" if value == 1.0:
                self._fed_s = self._now_s
            case "enable" if value == 1.0:
                self._fed_s = self._now_s
                self._command()
            case "enable" if self._by_host:
                self._release("given back")
            case "automatic" if not self._by_host:
                self._release("given back")

    def _command(self) -> None:
        self._by_host = True
        self._set(self._values["u"], "command")

    def _release(self, cause: str) -> None:
        """Leave the actuator to the device: to its controller without a bump, or to the safe output."""
        self._by_host = False
        if cause == "dead-man":
            self._values["automatic"] = 0.0
        if self._values["automatic"] == 1.0:
            self._y_filtered, self._y_rate = self.plant.measure(), 0.0
            self._error = self._values["setpoint"] - self._y_filtered
            self._tick_s = self._now_s + self._scan_s
            self._controlled = self._output - self._values["load"]
        else:
            self._set(self._values["safe"], cause)

    def _control(self) -> None:
        """One tick of the controller in velocity form, held within the actuator's range; no derivative of r."""
        K, Ti, Td, Tf = self._law(self._values)
        tick_s, load = self._scan_s, self._values["load"]
        before, rate = self._y_filtered, self._y_rate
        self._y_filtered += tick_s / (Tf + tick_s) * (self.plant.measure() - before)
        self._y_rate = (self._y_filtered - before) / tick_s
        error = self._values["setpoint"] - self._y_filtered
        low, high = self._u_range
        u = self._controlled + K * (error - self._error) + (K * tick_s / Ti * error if Ti > 0 else 0.0)
        u -= K * Td * (self._y_rate - rate)
        self._error = error
        self._tick_s += tick_s
        self._controlled = min(max(u, low - load), high - load)
        self._set(self._controlled + load, "controller")

    def _set(self, output: float, cause: str) -> None:
        self._output = output
        change = OutputChange(t_s=self._now_s, output=output, cause=cause)
        self.history.append(change)
        if self.on_change is not None:
            self.on_change(change)


def _isa(held: Mapping[str, float]) -> tuple[float, float, float, float]:
    return held["K"], held["Ti"], held["Td"], held["Tf"]
