"""What a rig behind registers needs of a transport."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from drivers.registers import Block


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

    def read(self, block: Block) -> tuple[Sequence[int], bool]:
        """Return the block's words, and whether they are suspect."""
        ...

    def write(self, table: str, address: int, words: Sequence[int]) -> bool:
        """Write words, and return whether that is suspect."""
        ...
