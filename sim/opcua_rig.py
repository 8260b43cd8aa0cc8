"""The simulated device behind a real OPC UA server, in real time, secured where it is given certificates."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from asyncua import ua
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.crypto.truststore import TrustStore
from asyncua.crypto.validator import CertificateValidator, CertificateValidatorOptions
from asyncua.server.server import Server
from asyncua.server.user_managers import UserManager

from sim.register_device import RegisterDevice
from sim.registers import from_words, to_words
from sim.served_rig import ServedRig

logging.getLogger("asyncua").addHandler(logging.NullHandler())

_CYCLE_S = 0.002
#: Time within which a connection must have a session [s], and connections at once.
PATIENCE_S, MOST_CONNECTIONS = 10.0, 200
_VARIANTS = {
    "float64": ua.VariantType.Double, "float32": ua.VariantType.Float, "boolean": ua.VariantType.Boolean,
    "int16": ua.VariantType.Int16, "uint16": ua.VariantType.UInt16, "int32": ua.VariantType.Int32,
    "uint32": ua.VariantType.UInt32, "int64": ua.VariantType.Int64, "uint64": ua.VariantType.UInt64,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ServedNode:
    """A node that shows a signal of the device.

    Attributes
    ----------
    node : str
        Its id.
    type : str
        Its data type.
    writable : bool
        Whether the host may write it.
    """

    node: str
    type: str
    writable: bool


@dataclass(frozen=True, kw_only=True)
class Security:
    """What the server wants of a client; nothing where everything is left out.

    Attributes
    ----------
    cert_file, key_file : str or None
        The server's own; with them it offers nothing but signed and encrypted connections.
    trusted : str or None
        Folder of the certificates that it trusts.
    users : mapping of str to str, or None
        Passwords by user; anybody where absent.
    """

    cert_file: str | None = None
    key_file: str | None = None
    trusted: str | None = None
    users: Mapping[str, str] | None = None


class OpcUaRig(ServedRig):
    """A device served in its own thread until the context ends.

    Parameters
    ----------
    device : RegisterDevice
        The device; its time runs with the wall clock from the start of the service.
    nodes : mapping of str to ServedNode
        Its signals.
    endpoint : str
        Where it is served.
    security : Security
        What it wants of a client.
    """

    start_s = 60.0

    def __init__(
        self, device: RegisterDevice, nodes: Mapping[str, ServedNode], endpoint: str, security: Security | None = None
    ) -> None:
        super().__init__(device, endpoint, "opc ua rig")
        self._nodes, self._endpoint, self._security = dict(nodes), endpoint, security or Security()
        self._taken_s = 0.0

    async def _serve(self, stop: asyncio.Event) -> None:
        server = await self._server()
        self._start_s = time.perf_counter()
        await self._add_nodes(server)
        async with server:
            living = asyncio.create_task(self._live())
            self._ready.set()
            await stop.wait()
            living.cancel()

    async def _server(self) -> Server:
        wants = self._security
        server = Server(user_manager=_Users(wants.users) if wants.users is not None else None)
        await server.init()
        server.iserver.max_pending_activation_seconds = PATIENCE_S
        server.iserver.max_connections = MOST_CONNECTIONS
        server.set_endpoint(self._endpoint)
        if wants.cert_file is None or wants.key_file is None:
            server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
            return server
        await server.load_certificate(wants.cert_file, "pem")
        await server.load_private_key(wants.key_file, format="pem")
        server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
        if wants.trusted is not None:
            store = TrustStore([Path(wants.trusted)], [])
            await store.load()
            server.set_certificate_validator(CertificateValidator(CertificateValidatorOptions.TRUSTED, store))
        return server

    async def _add_nodes(self, server: Server) -> None:
        space = max(ua.NodeId.from_string(one.node).NamespaceIndex for one in self._nodes.values())
        while len(await server.get_namespace_array()) <= space:
            await server.register_namespace(f"urn:ball:{len(await server.get_namespace_array())}")
        folder = await server.nodes.objects.add_object(space, "Ball")
        for name, one in self._nodes.items():
            kind = _VARIANTS[one.type]
            first = self._data_value(name, kind).Value
            node = await folder.add_variable(ua.NodeId.from_string(one.node), f"{space}:{name}", first)
            if one.writable:
                await node.set_writable()
            server.set_attribute_value_setter(node.nodeid, partial(self._take, name))
            server.set_attribute_value_callback(node.nodeid, partial(self._show, name, kind))

    def _show(self, name: str, kind: ua.VariantType, _id: ua.NodeId, _attribute: Any) -> ua.DataValue:
        return self._data_value(name, kind)

    def _data_value(self, name: str, kind: ua.VariantType) -> ua.DataValue:
        spec = self.device.registers[name]
        words = self.device.read(spec.table, spec.address, spec.size, self.now_s)
        count = (from_words(words, spec) - spec.offset) / spec.scale
        value: Any = count != 0.0 if kind is ua.VariantType.Boolean else count
        if kind not in (ua.VariantType.Boolean, ua.VariantType.Double, ua.VariantType.Float):
            value = round(count)
        now: Any = datetime.now(UTC)  # the library's own type of it is a datetime
        return ua.DataValue(ua.Variant(value, kind), SourceTimestamp=now)

    def _take(self, name: str, _node: Any, _attribute: Any, value: ua.DataValue) -> None:
        spec = self.device.registers[name]
        assert value.Value is not None
        words = to_words(spec.scale * float(value.Value.Value) + spec.offset, spec)
        # the nodes of one request come one after the other; a program takes them in one cycle
        if self.now_s - self._taken_s > _CYCLE_S:
            self._taken_s = self.now_s
        self.device.write(spec.table, spec.address, words, self._taken_s)


class _Users(UserManager):
    """Users by name and password."""

    def __init__(self, passwords: Mapping[str, str]) -> None:
        self._passwords = dict(passwords)

    def get_user(
        self, iserver: Any, username: str | None = None, password: str | None = None, certificate: Any = None
    ) -> User | None:
        """Return the user, or None where name or password is wrong."""
        known = username is not None and self._passwords.get(username) == password
        return User(role=UserRole.User, name=username) if known else None
