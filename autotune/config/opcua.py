"""Node map of a device behind an OPC UA server: which node holds which signal."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from autotune.config.registers import LOGICAL, RegisterMap
from autotune.config.signal_map import COUNTED, Held, SignalMap, SignalType, side_by_side
from autotune.schema import Number, Section

#: the server's time stamp of y
SOURCE_TIME = "device_time"


class NodeSettings(Section):
    """One signal: engineering value = scale x what the node holds + offset."""

    node: Annotated[
        str,
        Field(
            min_length=1,
            description='node id, "ns=2;s=Ball.y" or "ns=2;i=7", or path of browse names under Objects, "2:Ball/2:y"',
        ),
    ]
    type: Annotated[
        SignalType | None,
        Field(description="data type of the node; absent: float64, boolean of true and false, uint16 of a heartbeat"),
    ] = None
    scale: Annotated[Number, Field(description="engineering units per count, not 0")] = 1.0
    offset: Annotated[Number, Field(description="engineering value at count 0")] = 0.0


class NodeMap(SignalMap[NodeSettings]):
    """Nodes of the signals; a text is the node, a table its type, scale and offset too."""

    place_key: ClassVar[str] = "node"

    def type_of(self, name: str) -> SignalType:
        """Return the data type of a signal's node."""
        given: SignalType | None = getattr(self, name).type
        if given is not None:
            return given
        return "boolean" if name in LOGICAL else "uint16" if name in COUNTED else "float64"

    def registers(self) -> RegisterMap:
        """Return the nodes as registers side by side; y brings the server's time stamp along."""
        held = {name: Held(self.type_of(name), node.scale, node.offset) for name, node in self.mapped().items()}
        return side_by_side(held | {SOURCE_TIME: Held("float64", 1.0, 0.0)})
