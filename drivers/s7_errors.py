"""What a Siemens CPU, or the line to it, answers in place of data: one sentence and its remedy for each code."""

from __future__ import annotations

_OPTIMISED = "switch its 'Optimized block access' off in TIA Portal, compile and download; or correct the address"
_PUT_GET = "permit access with PUT/GET communication in the CPU's protection settings, and download them"
#: of one item of a request
_ITEM = {
    0x01: ("is where the CPU has a hardware fault", "look at the CPU's diagnostic buffer"),
    0x03: ("may not be accessed: the block is write-protected, or PUT/GET is not permitted",
           "take the block's write protection off; " + _PUT_GET),
    0x05: ("cannot be reached: the block has optimised access, or is too short", _OPTIMISED),
    0x06: ("is refused with its data type", "correct its type"),
    0x07: ("is refused with its length", "correct its type"),
    0x0A: ("is in a block that cannot be reached: it has optimised access, or is not there", _OPTIMISED),
}  # fmt: skip
#: of a whole request
_REQUEST = {
    0x8104: ("cannot be accessed: the CPU does not permit PUT/GET", _PUT_GET),
    0x8304: ("cannot be accessed: the CPU does not permit PUT/GET", _PUT_GET),
    0x8404: _ITEM[0x05],
    0x8500: ("is refused with its length", "map fewer signals, or nearer to each other"),
    0xD241: ("is behind a password", "permit full access without a password, or set another access level"),
    0xD401: ("is refused: the CPU does not offer that", _PUT_GET),
    0xD402: ("is refused: the CPU does not offer that", _PUT_GET),
    0xD602: ("is behind a password", "permit full access without a password, or set another access level"),
    0xD604: ("is behind a password", "permit full access without a password, or set another access level"),
}

#: the operating state in which a CPU's program runs
RUN = 0x08
STOPPED = "the CPU is in STOP"
STOPPED_REMEDY = "switch it to RUN: its program does not run, and nothing acts on what is written"
NO_ANSWER = ("no answer", "check network and load of the CPU, or raise timeout_s")
NO_CONNECTION = ("no connection", "check rig.host, rig.port, network and power of the CPU")
LOST = ("the connection was lost", "check cable, network and power of the CPU")
REFUSED = (
    "the CPU refuses the connection",
    "check rig.rack and rig.slot (0 and 1 of S7-1200 and S7-1500, 0 and 2 of S7-300), or end another client of it:"
    " it has connections for a few",
)


def item_refusal(code: int) -> tuple[str, str]:
    """Return what the return code of an item says of a place, as half a sentence, and its remedy."""
    return _ITEM.get(code, (f"is refused with code 0x{code:02X}", "see the CPU's manual"))


def request_refusal(code: int) -> tuple[str, str]:
    """Return what the error code of a request says of a place, as half a sentence, and its remedy."""
    return _REQUEST.get(code, (f"is refused with code 0x{code:04X}", "see the CPU's manual"))
