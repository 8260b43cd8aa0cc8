"""Nodes of an OPC UA server, read and written as registers: one request a sample, one a command, every write confirmed.

The library is asynchronous; its loop runs in a thread of its own while the link is connected. A lost connection, and a
server that restarts, are met by a new session and the request once more, which marks the sample suspect.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import struct
import threading
import time
from collections.abc import Coroutine, Sequence
from pathlib import Path
from typing import Any, TypeVar

from asyncua import ua
from asyncua.client.client import Client
from asyncua.common.node import Node
from asyncua.crypto import security_policies
from asyncua.crypto.uacrypto import CertProperties
from asyncua.ua.uaerrors import UaStatusCodeError
from cryptography import x509

from autotune.config.opcua import SOURCE_TIME
from autotune.config.rig import OpcUaSettings
from autotune.config.signal_map import SAMPLE
from autotune.errors import InputError, LinkError
from autotune.experiment.priority import before_others
from drivers.opcua_errors import ChannelRefusedError, refusal, sentence_on
from drivers.register_link import Answer
from drivers.registers import Block, Codec, codecs
from drivers.session_lock import SessionLock

# the library logs what is raised here anyway; without a handler Python would print it
logging.getLogger("asyncua").addHandler(logging.NullHandler())

_T = TypeVar("_T")
_POLICIES: dict[str, Any] = {
    "Basic256Sha256": security_policies.SecurityPolicyBasic256Sha256,
    "Aes128Sha256RsaOaep": security_policies.SecurityPolicyAes128Sha256RsaOaep,
    "Aes256Sha256RsaPss": security_policies.SecurityPolicyAes256Sha256RsaPss,
}
#: data types of nodes by what the configuration calls them
_VARIANTS = {
    "float64": ua.VariantType.Double, "float32": ua.VariantType.Float, "boolean": ua.VariantType.Boolean,
    "int16": ua.VariantType.Int16, "uint16": ua.VariantType.UInt16, "int32": ua.VariantType.Int32,
    "uint32": ua.VariantType.UInt32, "int64": ua.VariantType.Int64, "uint64": ua.VariantType.UInt64,
}  # fmt: skip
_NAMES = {variant: name for name, variant in _VARIANTS.items()}
#: what is nobody's refusal
_DEFECTS = (AssertionError, AttributeError, ImportError, NameError, TypeError)
#: time-outs of a request that a whole connection may take: hello, channel, session, nodes
_CONNECT = 5.0


class OpcUaLink:
    """One device behind an OPC UA server; see :class:`drivers.register_link.RegisterLink`.

    Parameters
    ----------
    settings : OpcUaSettings
        Endpoint, security, nodes.
    exclusive : bool
        Whether no other session of this computer may have the device meanwhile.
    """

    def __init__(self, settings: OpcUaSettings, *, exclusive: bool = True) -> None:
        self._settings = settings
        self._lock = SessionLock(self.where, exclusive=exclusive)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = threading.Thread()
        self._client: Client | None = None
        self._nodes: dict[str, Node] = {}
        # scale and offset are the rig's: here a word is what the node holds
        plain = {"scale": 1.0, "offset": 0.0}
        mapped = settings.registers.mapped()
        self._raw = codecs({name: register.model_copy(update=plain) for name, register in mapped.items()})
        self._at: dict[tuple[str, int], str] = {
            (codec.register.table, codec.register.address): name for name, codec in self._raw.items()
        }
        self._began_s = math.nan  # of the server's time stamps

    @property
    def where(self) -> str:
        """The server, for messages."""
        return f"OPC UA {self._settings.endpoint}"

    def connect(self) -> None:
        """Connect, and look whether every node is there, of its type, and may be written where it has to be.

        Raises
        ------
        InputError
            A certificate, key or password cannot be read.
        LinkError
            Nobody answers, or the server refuses host, user or a node.
        """
        if self._client is not None:
            return
        is_first = self._lock.take()
        try:
            client = self._new_client()
            self._start()
            self._client = client
            self._ask(self._open(client), _CONNECT * self._settings.timeout_s)
        except BaseException as error:
            self._hang_up()
            if is_first:
                self._lock.give_back()
            if isinstance(error, (KeyboardInterrupt, InputError, LinkError, *_DEFECTS)):
                raise
            raise self._link_error(error) from None

    def disconnect(self) -> None:
        """Disconnect; may be called more than once, and does not raise."""
        self._hang_up()
        self._lock.give_back()

    def distrust(self) -> None:
        """Nothing: answers are paired with their requests by the protocol."""

    def read(self, block: Block) -> Answer:
        """Read the nodes of a block in one request.

        Raises
        ------
        LinkError
            No answer in all attempts, or a node that the server does not show.
        """
        names = [codec.name for codec, _ in block.parts]
        nodes = [name for name in names if name != SOURCE_TIME]
        values, attempts, took_s = self._exchange(lambda: self._read(nodes))
        words: list[int] = []
        for name in names:
            if name == SOURCE_TIME:
                words += struct.unpack(">4H", struct.pack(">d", self._stamp(values[nodes.index("y")])))
                continue
            value = values[nodes.index(name)]
            if value.StatusCode is not None and value.StatusCode.is_bad():
                raise self._refusal(name, value.StatusCode.name)
            words += _words(self._raw[name], value.Value.Value if value.Value is not None else None)
        return Answer(words, attempts > 1, took_s)

    def write(self, table: str, address: int, words: Sequence[int]) -> bool:
        """Write nodes that lie side by side in the map, in one request that the server confirms node by node.

        Parameters
        ----------
        table : str
            As the map has it.
        address : int
            Of the first word.
        words : sequence of int
            16 bits each.

        Raises
        ------
        LinkError
            No answer in all attempts, or a node that the server does not let be written.
        """
        names, values, left = [], [], list(words)
        while left:
            name = self._at[table, address]
            size = self._raw[name].register.words
            names.append(name)
            values.append(_variant(self._raw[name], _VARIANTS[self._settings.nodes.type_of(name)], left[:size]))
            address, left = address + size, left[size:]
        codes, attempts, _ = self._exchange(lambda: self._write(names, values))
        for name, code in zip(names, codes, strict=True):
            if code.is_bad():
                raise self._refusal(name, code.name)
        return attempts > 1

    def read_numbers(self, place: str) -> list[float]:
        """Return the numbers of an array, by its node or browse names.

        Raises
        ------
        LinkError
            No answer in all attempts, or no such array.
        """
        value, _, _ = self._exchange(lambda: self._read_array(place))
        if value.StatusCode is not None and value.StatusCode.is_bad():
            raise self._refusal_at("the array", place, value.StatusCode.name)
        if value.Value is None or value.Value.VariantType is not ua.VariantType.Double:
            raise self._refusal_at("the array", place, "BadTypeMismatch")
        held = value.Value.Value
        return [float(number) for number in (held if isinstance(held, list) else [held])]

    def may_write(self, place: str) -> bool:
        """Return whether the server lets this user write a node."""
        access, _, _ = self._exchange(lambda: self._access(place))
        return ua.AccessLevel.CurrentWrite in access

    def write_numbers(self, place: str, numbers: Sequence[float]) -> None:
        """Write the numbers of an array, all in one request.

        Parameters
        ----------
        place : str
            The array's node.
        numbers : sequence of float
            All of its elements.

        Raises
        ------
        LinkError
            No answer in all attempts, or the server does not let it be written.
        """
        (code,), _, _ = self._exchange(lambda: self._write_array(place, list(numbers)))
        if code.is_bad():
            raise self._refusal_at("the array", place, code.name)

    async def _read_array(self, place: str) -> ua.DataValue:
        assert self._client is not None
        node = await self._node(self._client, place)
        (value,) = await self._client.read_attributes([node])
        return value

    async def _access(self, place: str) -> set[ua.AccessLevel]:
        assert self._client is not None
        return await (await self._node(self._client, place)).get_user_access_level()

    async def _write_array(self, place: str, numbers: list[float]) -> list[ua.StatusCode]:
        assert self._client is not None
        node = await self._node(self._client, place)
        value = ua.DataValue(ua.Variant(numbers, ua.VariantType.Double))
        return await self._client.uaclient.write_attributes([node.nodeid], [value])

    async def _open(self, client: Client) -> None:
        settings = self._settings
        if settings.security_policy != "None":
            await client.set_security(
                _POLICIES[settings.security_policy],
                _file(settings.cert_file),
                _file(settings.key_file),
                server_certificate=_file(settings.server_cert_file),
                mode=getattr(ua.MessageSecurityMode, settings.security_mode),
            )
        try:
            await client.connect()
        except AssertionError:  # the library's, of an answer that refuses the channel
            raise ChannelRefusedError from None
        for name, given in settings.nodes.mapped().items():
            try:
                node = await self._node(client, given.node)
                held = (await node.read_data_value()).Value
                access = await node.get_user_access_level()
            except UaStatusCodeError as error:
                raise self._refusal(name, type(error).__name__) from None
            wanted = settings.nodes.type_of(name)
            variant = held.VariantType if held is not None else ua.VariantType.Null
            if variant is not _VARIANTS[wanted]:
                told = _NAMES.get(variant)
                raise LinkError(
                    f"the node of {name} holds {variant.name}, not {wanted}",
                    where=f"{self.where}, {given.node}",
                    remedy=f'give rig.nodes.{name} its type = "{told}", and scale and offset' if told else
                    "map a node that holds a number",
                )  # fmt: skip
            if name not in SAMPLE and ua.AccessLevel.CurrentWrite not in access:
                raise self._refusal(name, "BadNotWritable")
            self._nodes[name] = node

    async def _node(self, client: Client, given: str) -> Node:
        """Return the node of an id, or of a path of browse names under Objects."""
        if "=" in given:
            return client.get_node(ua.NodeId.from_string(given))
        return await client.nodes.objects.get_child(given.strip("/").split("/"))

    async def _read(self, names: Sequence[str]) -> list[ua.DataValue]:
        assert self._client is not None
        return await self._client.read_attributes([self._nodes[name] for name in names])

    async def _write(self, names: Sequence[str], values: Sequence[ua.Variant]) -> list[ua.StatusCode]:
        assert self._client is not None
        nodes = [self._nodes[name].nodeid for name in names]
        # without time stamps: a server may refuse a client's
        return await self._client.uaclient.write_attributes(nodes, [ua.DataValue(value) for value in values])

    def _exchange(self, ask: Any) -> tuple[Any, int, float]:
        """Ask until there is an answer; return it, the number of attempts and how long the last one took [s]."""
        failure: LinkError | None = None
        for attempt in range(1, self._settings.retries + 2):
            try:
                self.connect()
                sent_s = time.perf_counter()
                return self._ask(ask(), self._settings.timeout_s), attempt, time.perf_counter() - sent_s
            except LinkError as error:
                failure = error
            except _DEFECTS:
                raise
            except Exception as error:  # whatever the library raises where the line is gone
                failure = self._link_error(error)
            self._hang_up()
        assert failure is not None
        raise failure

    def _new_client(self) -> Client:
        settings = self._settings
        client = Client(settings.endpoint, timeout=settings.timeout_s, watchdog_intervall=3600.0)
        client.name = client.description = "autotune"
        if settings.cert_file is not None:
            client.application_uri = _application_uri(Path(settings.cert_file)) or client.application_uri
        if settings.user is not None and settings.password_file is not None:
            client.set_user(settings.user)
            client.set_password(Path(settings.password_file).read_text(encoding="utf-8").splitlines()[0])
        return client

    def _start(self) -> None:
        """Start the thread that the library's loop runs in."""
        loop = asyncio.new_event_loop()

        def run() -> None:
            with before_others():  # the control loop waits for its answers
                loop.run_forever()
            loop.close()

        self._loop, self._thread = loop, threading.Thread(target=run, name="opc ua", daemon=True)
        self._thread.start()

    def _ask(self, request: Coroutine[Any, Any, _T], timeout_s: float) -> _T:
        """Run a request in the library's loop; a request that is given up does not go on."""
        assert self._loop is not None
        waiting = asyncio.run_coroutine_threadsafe(asyncio.wait_for(request, timeout_s), self._loop)
        try:
            return waiting.result()
        except BaseException:
            waiting.cancel()
            raise

    def _hang_up(self) -> None:
        client, loop = self._client, self._loop
        self._client, self._loop, self._nodes = None, None, {}
        if loop is None:
            return
        if client is not None:
            with contextlib.suppress(Exception):
                farewell = asyncio.wait_for(client.disconnect(), self._settings.timeout_s)
                asyncio.run_coroutine_threadsafe(farewell, loop).result()
        with contextlib.suppress(Exception):
            asyncio.run_coroutine_threadsafe(_cancel_all(), loop).result(self._settings.timeout_s)
        loop.call_soon_threadsafe(loop.stop)
        self._thread.join(self._settings.timeout_s)

    def _stamp(self, value: ua.DataValue) -> float:
        """Return the time that the server's source took y, from its first on [s]; NaN where it does not say."""
        stamp = value.SourceTimestamp
        if stamp is None:
            return math.nan
        at_s = stamp.timestamp()
        self._began_s = at_s if math.isnan(self._began_s) else self._began_s
        return at_s - self._began_s

    def _refusal(self, name: str, code: str) -> LinkError:
        return self._refusal_at(f"the node of {name}", getattr(self._settings.nodes, name).node, code)

    def _refusal_at(self, which: str, place: str, code: str) -> LinkError:
        what, remedy = refusal(code)
        return LinkError(f"{which} {what}", where=f"{self.where}, {place}", remedy=remedy)

    def _link_error(self, error: BaseException) -> LinkError:
        what, remedy = sentence_on(error)
        return LinkError(what, where=self.where, remedy=remedy)


def _file(path: str | None) -> CertProperties:
    """Return a certificate or key with the form that it has, whatever its name says."""
    is_pem = Path(str(path)).read_bytes().startswith(b"-----")
    return CertProperties(str(path), extension="pem" if is_pem else "der")


async def _cancel_all() -> None:
    """End what the library left running."""
    others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)


def _words(raw: Codec, value: Any) -> Sequence[int]:
    """Return the words of what a node holds; where it holds nothing, or no number, those of NaN or 0."""
    if isinstance(value, bool):
        return (int(value),)
    number = math.nan if value is None else float(value)
    if raw.register.type == "float64":
        return struct.unpack(">4H", struct.pack(">d", number))
    if raw.register.type == "float32":
        return struct.unpack(">2H", struct.pack(">f", number))
    return raw.encode(number)


def _variant(raw: Codec, kind: ua.VariantType, words: Sequence[int]) -> ua.Variant:
    value = raw.decode(words)
    if kind is ua.VariantType.Boolean:
        return ua.Variant(value != 0.0, kind)
    is_float = kind in (ua.VariantType.Double, ua.VariantType.Float)
    return ua.Variant(value if is_float else round(value), kind)


def _application_uri(cert_file: Path) -> str:
    """Return the URI that a certificate says its application is; a server compares it."""
    data = cert_file.read_bytes()
    try:
        is_pem = data.startswith(b"-----")
        certificate = x509.load_pem_x509_certificate(data) if is_pem else x509.load_der_x509_certificate(data)
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except ValueError:
        raise InputError(
            "is no certificate", where=str(cert_file), remedy="give PEM or DER; see docs/opcua.md"
        ) from None
    except x509.ExtensionNotFound:
        return ""
    return next(iter(names.get_values_for_type(x509.UniformResourceIdentifier)), "")
