"""A Siemens CPU: its address, and which place in its data blocks holds which signal."""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import combinations
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from pydantic import Field, model_validator

from autotune.config.link import Feed, Retries, Timeout
from autotune.config.registers import LOGICAL, RegisterMap
from autotune.config.signal_map import Held, SignalMap, SignalType, side_by_side
from autotune.config.twin import TwinSettings
from autotune.schema import Number, Section

S7Type = Literal[
    "BOOL", "INT", "UINT", "WORD", "DINT", "UDINT", "DWORD", "TIME", "REAL", "LINT", "ULINT", "LWORD", "LREAL"
]
#: what registers call the types, which are big-endian all
_HELD: dict[S7Type, SignalType] = {
    "BOOL": "boolean", "INT": "int16", "UINT": "uint16", "WORD": "uint16", "DINT": "int32", "UDINT": "uint32",
    "DWORD": "uint32", "TIME": "int32", "REAL": "float32", "LINT": "int64", "ULINT": "uint64", "LWORD": "uint64",
    "LREAL": "float64",
}  # fmt: skip
#: bytes of a type; a BOOL is a bit
SIZES: dict[S7Type, int] = {
    kind: {"boolean": 1, "16": 2, "32": 4, "64": 8}[held if held == "boolean" else held[-2:]]
    for kind, held in _HELD.items()
}
#: types by the letter of an address, the first where nothing is said
_BY_LETTER: dict[str, tuple[S7Type, ...]] = {
    "W": ("INT", "UINT", "WORD"),
    "D": ("REAL", "DINT", "UDINT", "DWORD", "TIME"),
    "X": ("BOOL", "LREAL", "LINT", "ULINT", "LWORD"),
}
_ADDRESS = re.compile(r"DB([1-9]\d{0,4})\.DB([XWD])(\d{1,5})(?:\.([0-7]))?")
#: a TIME counts milliseconds
_TIME_S = 1e-3


class Place(NamedTuple):
    """Where a signal is: data block, first byte, bit within it (0 where it is no BOOL)."""

    block: int
    byte: int
    bit: int


class S7Signal(Section):
    """One signal: engineering value = scale x what is there + offset; of a TIME what is there is in seconds."""

    address: Annotated[
        str,
        Field(description='place in a data block without optimised access, "DB10.DBD4", "DB10.DBW8", "DB10.DBX10.0"'),
    ]
    type: Annotated[
        S7Type | None,
        Field(description="data type in the block; absent: REAL of a DBD, INT of a DBW, BOOL of a DBX"),
    ] = None
    scale: Annotated[Number, Field(description="engineering units per count, not 0")] = 1.0
    offset: Annotated[Number, Field(description="engineering value at count 0")] = 0.0

    @model_validator(mode="after")
    def _consistent(self) -> S7Signal:
        found = _ADDRESS.fullmatch(self.address)
        if found is None:
            raise ValueError(
                f'{self.address!r} is no place in a data block: write "DB10.DBD4", "DB10.DBW8" or "DB10.DBX10.0"'
            )
        letter, bit = found[2], found[4]
        if (letter == "X") != (bit is not None):
            raise ValueError(f"{self.address!r}: a bit follows DBX, as in DB10.DBX10.0, and nothing else")
        if self.type is not None and self.type not in _BY_LETTER[letter]:
            fits = next(key for key, types in _BY_LETTER.items() if self.type in types)
            raise ValueError(f"{self.address!r} holds no {self.type}: that is a DB{fits}{' at .0' * (fits == 'X')}")
        if self.kind != "BOOL" and bit not in (None, "0"):
            raise ValueError(f"{self.address!r}: a {self.kind} begins at bit 0 of its byte")
        if self.kind == "BOOL" and (self.scale, self.offset) != (1.0, 0.0):
            raise ValueError(f"{self.address!r}: a BOOL has no scale and no offset")
        return self

    @property
    def kind(self) -> S7Type:
        """The data type, also where nothing is said."""
        return self.type or _BY_LETTER[self.address.split(".DB")[1][0]][0]

    @property
    def place(self) -> Place:
        """Where it is."""
        found = _ADDRESS.fullmatch(self.address)
        assert found is not None
        return Place(int(found[1]), int(found[3]), int(found[4] or 0))

    @property
    def held(self) -> Held:
        """The signal as a register holds it."""
        return Held(_HELD[self.kind], self.scale * (_TIME_S if self.kind == "TIME" else 1.0), self.offset)


class S7Gains(Section):
    """The device's own controller in its maker's form: where each setting is."""

    form: Annotated[
        str, Field(description='the form, as autotune controller --help lists them; "siemens": PID_Compact')
    ]
    u_span: Annotated[Number, Field(gt=0, description="engineering span of the output, for percent forms [u unit]")] = (
        1.0
    )
    y_span: Annotated[Number, Field(gt=0, description="engineering span of the measurement [y unit]")] = 1.0
    settings: Annotated[
        Mapping[str, S7Signal], Field(description="place by setting, as the form calls it; a text is the place")
    ]
    fixed: Annotated[
        Mapping[str, Number], Field(description="settings that the device has and that are set by hand")
    ] = {}

    @model_validator(mode="before")
    @classmethod
    def _texts(cls, given: Any) -> Any:
        if not isinstance(given, dict) or not isinstance(given.get("settings"), dict):
            return given
        named = given["settings"].items()
        return given | {"settings": {name: {"address": one} if isinstance(one, str) else one for name, one in named}}


class S7Map(SignalMap[S7Signal]):
    """Places of the signals; a text is the place, a table its type, scale and offset too."""

    place_key: ClassVar[str] = "address"

    device_time: Annotated[S7Signal | None, Field(description="the device's time stamp of the sample [s]")] = None
    gains: Annotated[S7Gains | None, Field(description="the gains in a maker's form, in place of K, Ti, Td, Tf")] = None

    def mapped(self) -> dict[str, S7Signal]:
        """Return the signals that are mapped, by name; settings of a maker's form as ``gains.NAME``."""
        found = super().mapped()
        found.pop("gains", None)
        settings = self.gains.settings if self.gains is not None else {}
        return found | {f"gains.{name}": signal for name, signal in settings.items()}

    def registers(self) -> RegisterMap:
        """Return the places as registers side by side."""
        gains = self.gains.model_dump(exclude={"settings"}) if self.gains is not None else None
        return side_by_side({name: signal.held for name, signal in self.mapped().items()}, gains)

    @model_validator(mode="after")
    def _apart(self) -> S7Map:
        for name, signal in self.mapped().items():
            if (signal.kind == "BOOL") != (name in LOGICAL) and (signal.kind == "BOOL" or signal.kind == "REAL"):
                wanted = (
                    "is true or false: a BOOL, or a whole number" if name in LOGICAL else "is a number, and no BOOL"
                )
                raise ValueError(f"{name} at {signal.address} {wanted}")
        beat, echo = self.heartbeat, self.heartbeat_echo
        if beat is not None and echo is not None and beat.kind != echo.kind:
            raise ValueError(f"heartbeat is a {beat.kind} and heartbeat_echo a {echo.kind}: give both one type")
        # the echo may be the heartbeat's own place, read back
        named = [(name, signal) for name, signal in self.mapped().items() if name != "heartbeat_echo"]
        for (one, a), (other, b) in combinations(named, 2):
            if _overlap(a, b):
                raise ValueError(f"{one} at {a.address} and {other} at {b.address} overlap")
        return self


def _overlap(a: S7Signal, b: S7Signal) -> bool:
    (block, start, bit), (other_block, other_start, other_bit) = a.place, b.place
    if block != other_block or start >= other_start + SIZES[b.kind] or other_start >= start + SIZES[a.kind]:
        return False
    return not (a.kind == b.kind == "BOOL" and bit != other_bit)


class S7Settings(Section):
    """A Siemens CPU whose data blocks are read and written over S7 communication (PUT/GET)."""

    kind: Literal["s7"]
    host: Annotated[str, Field(description="address of the CPU; loopback by default")] = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535, description="TCP port, 1..65535")] = 102
    rack: Annotated[int, Field(ge=0, le=7, description="rack of the CPU, 0..7")] = 0
    slot: Annotated[
        int, Field(ge=0, le=31, description="slot of the CPU, 0..31: 1 of S7-1200 and S7-1500, 2 of S7-300")
    ] = 1
    timeout_s: Timeout = 0.5
    retries: Retries = 1
    feed_s: Feed = 0.1
    scan_time_s: Annotated[
        float | None, Field(gt=0, le=60, description="cycle of the CPU's program [s]; absent: not known, 0.02")
    ] = None
    signals: S7Map
    twin: TwinSettings | None = None

    @property
    def registers(self) -> RegisterMap:
        """The places as registers."""
        return self.signals.registers()
