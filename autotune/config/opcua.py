"""Node map of a device behind an OPC UA server: which node holds which signal."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from autotune.config.registers import RegisterMap
from autotune.schema import Number, Section

#: what a node may hold; a register has the same names
NodeType = Literal["float64", "float32", "int16", "uint16", "int32", "uint32", "int64", "uint64", "boolean"]
#: words of a number as registers carry it
WORDS = {"float64": 4, "float32": 2, "int16": 1, "uint16": 1, "int32": 2, "uint32": 2, "int64": 4, "uint64": 4}
#: signals that are true or false, and those that count
_LOGICAL, _COUNTED = ("enable", "in_command", "automatic"), ("heartbeat", "heartbeat_echo")
#: signals that a sample is made of, read in one request; the others are written
SAMPLE = ("y", "u_applied", "heartbeat_echo", "in_command")
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
        NodeType | None,
        Field(description="data type of the node; absent: float64, boolean of true and false, uint16 of a heartbeat"),
    ] = None
    scale: Annotated[Number, Field(description="engineering units per count, not 0")] = 1.0
    offset: Annotated[Number, Field(description="engineering value at count 0")] = 0.0


def _node(description: str) -> Any:
    return Field(default=None, description=description)


class NodeMap(Section):
    """Nodes of the signals; a text is the node, a table its type, scale and offset too."""

    y: Annotated[NodeSettings, Field(description="measurement [y unit]")]
    u: Annotated[NodeSettings, Field(description="command from the host [u unit]")]
    u_applied: NodeSettings | None = _node("output the device applies [u unit]")
    heartbeat: NodeSettings | None = _node("counter the host writes; the device is safe where it stands still")
    heartbeat_echo: NodeSettings | None = _node("the last heartbeat that the device's program took")
    enable: NodeSettings | None = _node("true while the host commands the actuator, false to give it back")
    in_command: NodeSettings | None = _node("true while the device lets the host's command act")
    safe: NodeSettings | None = _node("output that the device sets when the host falls silent [u unit]")
    automatic: NodeSettings | None = _node("true while the device's own controller may run")
    setpoint: NodeSettings | None = _node("set-point of the device's own controller [y unit]")
    load: NodeSettings | None = _node("added to the output of the device's own controller [u unit]")
    K: NodeSettings | None = _node("proportional gain of the device's own controller [u unit/y unit]")
    Ti: NodeSettings | None = _node("integral time of the device's own controller [s]")
    Td: NodeSettings | None = _node("derivative time of the device's own controller [s]")
    Tf: NodeSettings | None = _node("time constant of the device's own measurement filter [s]")

    @model_validator(mode="before")
    @classmethod
    def _texts(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        return {name: {"node": value} if isinstance(value, str) else value for name, value in given.items()}

    def mapped(self) -> dict[str, NodeSettings]:
        """Return the signals that are mapped, by name."""
        return {name: node for name in type(self).model_fields if (node := getattr(self, name)) is not None}

    def type_of(self, name: str) -> NodeType:
        """Return the data type of a signal's node."""
        given: NodeType | None = getattr(self, name).type
        if given is not None:
            return given
        return "boolean" if name in _LOGICAL else "uint16" if name in _COUNTED else "float64"

    def registers(self) -> RegisterMap:
        """Return the nodes as registers side by side, which the driver of register rigs knows.

        What a sample is made of lies in one table, so that it is one request, and the rest in the order in which it is
        written. A node of true and false is a word that is 1 or 0; y brings the server's time stamp along.
        """
        found: dict[str, Any] = {}
        at = {"input": 0, "holding": 0}
        for name, node in self.mapped().items():
            kind = self.type_of(name)
            table = "input" if name in SAMPLE else "holding"
            kind_there = "uint16" if kind == "boolean" else kind
            found[name] = {
                "table": table, "address": at[table], "type": kind_there, "scale": node.scale, "offset": node.offset
            }  # fmt: skip
            at[table] += WORDS[kind_there]
        found[SOURCE_TIME] = {"table": "input", "address": at["input"], "type": "float64"}
        return RegisterMap.model_validate(found)

    @model_validator(mode="after")
    def _consistent(self) -> NodeMap:
        self.registers()  # what holds of registers holds of nodes
        return self
