"""What a rig behind registers needs of a transport."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from drivers.registers import Block


class Answer(NamedTuple):
    """A block of registers, as it was read.

    Attributes
    ----------
    words : sequence of int
        As many as the block counts; 0 or 1 each for bits.
    suspect : bool
        Whether it took more than one attempt.
    took_s : float
        Time from sending the request that was answered to its answer [s], without the attempts before it.
    """

    words: Sequence[int]
    suspect: bool
    took_s: float


class RegisterLink(Protocol):
    """What a rig needs of a transport; every method may raise LinkError."""

    @property
    def where(self) -> str:
        """The device, for messages."""
        ...

    def connect(self) -> None:
        """Connect; nothing where there is a connection."""
        ...

    def disconnect(self) -> None:
        """Disconnect; may be called more than once."""
        ...

    def distrust(self) -> None:
        """Make sure that no earlier answer is taken for the next one."""
        ...

    def read(self, block: Block) -> Answer:
        """Return the block's words, whether they are suspect, and how long they took."""
        ...

    def write(self, table: str, address: int, words: Sequence[int]) -> bool:
        """Write words, and return whether that is suspect.

        Parameters
        ----------
        table : str
            Which of the device's tables.
        address : int
            Of the first word.
        words : sequence of int
            16 bits each.
        """
        ...
