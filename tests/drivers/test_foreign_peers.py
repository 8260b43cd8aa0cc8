"""Modbus peers that nobody here wrote: slaves for the driver, masters for the served rig."""

from __future__ import annotations

import math
import shutil
import struct
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import minimalmodbus
import modbus_tk.defines
import pytest
import serial
from modbus_tk.modbus_rtu import RtuServer
from pyModbusTCP.client import ModbusClient
from pyModbusTCP.server import DataBank, ModbusServer

from autotune.config.registers import RegisterMap
from autotune.controller import PIDController
from autotune.errors import LinkError, NotTaken
from drivers.modbus import DeviceRefused
from sim.modbus_rig import ModbusRig, RtuTransport, TcpTransport
from sim.plant import make_plant
from sim.serial_line import SerialLine
from tests.drivers.bench import U_SAFE, register_device, rig_of, rtu_settings, tcp_settings

#: what libmodbus_slave.c has
SLAVE = RegisterMap.model_validate(
    {
        "y": {"table": "input", "address": 0, "type": "float32"},
        "u_applied": {"table": "input", "address": 2, "scale": 1e-3},
        "heartbeat_echo": {"table": "input", "address": 3, "type": "uint16"},
        "u": {"address": 0, "scale": 1e-3},
        "heartbeat": {"address": 1, "type": "uint16"},
        "enable": {"table": "coil", "address": 0, "type": "bit"},
        "K": {"address": 10, "type": "float32"},
        "Ti": {"address": 12, "type": "float32"},
    }
)
#: what slaves with plain memory have: y is the command's own register, read back
MEMORY = RegisterMap.model_validate(
    {
        "y": {"table": "input", "address": 7, "type": "float32", "word_order": "little"},
        "u": {"address": 0, "scale": 1e-3},
        "enable": {"table": "coil", "address": 3, "type": "bit"},
        "K": {"address": 10, "type": "float32"},
        "Ti": {"address": 12, "type": "uint16", "scale": 1e-2},
    }
)


@pytest.fixture(scope="session")
def slave_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    program = tmp_path_factory.mktemp("slave") / "slave"
    source = Path(__file__).with_name("libmodbus_slave.c")
    command = ["gcc", "-O2", "-Wall", "-Wextra", "-I/usr/include/modbus", "-o", program, source, "-lmodbus"]
    subprocess.run(command, check=True)
    return program


@contextmanager
def running(program: Path, *words: str) -> Iterator[int]:
    with subprocess.Popen([program, *words], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield int(process.stdout.readline().split()[1])
        finally:
            process.kill()


@pytest.mark.system("libmodbus-dev", "gcc")
def test_a_c_slave_on_tcp(slave_program: Path) -> None:
    with running(slave_program, "tcp") as port:
        rig = rig_of(tcp_settings(port, SLAVE))
        rig.open()
        for u in (0.25, -0.75, 3.0):
            rig.write(u)
            reading = rig.read()
            assert reading.y == pytest.approx(2.0 * u)
            assert reading.u_applied == pytest.approx(u)
        rig.write_gains(PIDController(K=-0.025, Ti_s=3.5))  # type: ignore[attr-defined]  # HoldsGains
        held = rig.read_gains()  # type: ignore[attr-defined]
        assert (held.K, held.Ti_s) == pytest.approx((-0.025, 3.5))
        assert held.kind == "pi"
        rig.make_safe()
        assert rig.read().u_applied == U_SAFE
        rig.close()


@pytest.mark.system("libmodbus-dev", "gcc")
def test_a_c_slave_on_a_serial_line(slave_program: Path) -> None:
    with SerialLine() as line, running(slave_program, "rtu", line.rig_device):
        rig = rig_of(rtu_settings(line.host_device, SLAVE))
        rig.open()
        for u in (0.25, -0.75, 3.0):
            rig.write(u)
            assert rig.read().y == pytest.approx(2.0 * u)
        rig.make_safe()
        assert rig.read().u_applied == U_SAFE
        rig.close()


@pytest.mark.system("libmodbus-dev", "gcc")
@pytest.mark.parametrize(("signal", "said", "error"), [("y", "input", NotTaken), ("u", "holding", DeviceRefused)])
def test_an_address_that_a_c_slave_does_not_have_is_named(
    slave_program: Path, signal: str, said: str, error: type[LinkError]
) -> None:
    """What is read before anything is written leaves a rig that was not taken; a refused write has begun it."""
    beyond = SLAVE.model_copy(update={signal: getattr(SLAVE, signal).model_copy(update={"address": 100})})
    with running(slave_program, "tcp") as port:
        rig = rig_of(tcp_settings(port, beyond))
        with pytest.raises(error, match=rf"{said} 100.*does not have that address"):
            rig.open()
        rig.close()


def test_a_pure_python_slave_on_tcp() -> None:
    memory = DataBank()
    server = ModbusServer("127.0.0.1", 0, no_block=True, data_bank=memory)
    server.start()
    port = server._service.server_address[1]
    try:
        high, low = struct.unpack(">HH", struct.pack(">f", -1.25))
        memory.set_input_registers(7, [low, high])
        rig = rig_of(tcp_settings(port, MEMORY))
        rig.open()
        rig.write(-0.75)
        assert memory.get_holding_registers(0) == [0x10000 - 750]
        assert memory.get_coils(3) == [True]
        assert rig.read().y == -1.25
        rig.write_gains(PIDController(K=1.5, Ti_s=3.59))  # type: ignore[attr-defined]  # HoldsGains
        assert memory.get_holding_registers(10, 3) == [0x3FC0, 0x0000, 359]
        rig.make_safe()
        assert memory.get_holding_registers(0) == [0x10000 - 500]
        assert memory.get_coils(3) == [False]
        rig.close()
    finally:
        server.stop()


@pytest.mark.filterwarnings("ignore:isSet:DeprecationWarning")  # inside modbus-tk
def test_another_python_slave_on_a_serial_line() -> None:
    with SerialLine() as line:
        server = RtuServer(serial.Serial(line.rig_device, 115200))
        server.start()
        try:
            slave = server.add_slave(1)
            slave.add_block("inputs", modbus_tk.defines.ANALOG_INPUTS, 7, 2)
            slave.add_block("registers", modbus_tk.defines.HOLDING_REGISTERS, 0, 20)
            slave.add_block("coils", modbus_tk.defines.COILS, 0, 8)
            high, low = struct.unpack(">HH", struct.pack(">f", 6.5))
            slave.set_values("inputs", 7, [low, high])
            rig = rig_of(rtu_settings(line.host_device, MEMORY))
            rig.open()
            rig.write(0.25)
            assert slave.get_values("registers", 0, 1) == (250,)
            assert slave.get_values("coils", 3, 1) == (1,)
            assert rig.read().y == 6.5
            rig.make_safe()
            assert slave.get_values("coils", 3, 1) == (0,)
            rig.close()
        finally:
            server.stop()


def test_nobody_there_is_said_in_one_line() -> None:
    server = ModbusServer("127.0.0.1", 0, no_block=True)
    server.start()
    port = server._service.server_address[1]
    server.stop()  # now nobody listens
    rig = rig_of(tcp_settings(port, MEMORY))
    with pytest.raises(LinkError, match=f"127.0.0.1:{port} unit 1: no connection .*refused.*check address"):
        rig.open()


def mbpoll(port: int, *words: str) -> str:
    program = shutil.which("mbpoll")
    assert program is not None
    command = [program, "-m", "tcp", "-p", str(port), "-a", "1", "-0", "-1", "-o", "5", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
    return done.stdout


@pytest.mark.system("mbpoll")
def test_a_c_master_moves_and_reads_the_served_rig() -> None:
    device = register_device()
    with ModbusRig(device, TcpTransport()) as server:
        mbpoll(server.port, "-t", "4", "-r", "0", "127.0.0.1", str(0x10000 - 250), "17")  # command and heartbeat
        mbpoll(server.port, "-t", "0", "-r", "17", "127.0.0.1", "1")  # enable
        shown = mbpoll(server.port, "-t", "3", "-r", "2", "-c", "2", "127.0.0.1")
        assert "65286 (-250)" in shown  # u_applied
        assert "[3]: \t17" in shown  # heartbeat echo
        assert device.output == pytest.approx(-0.25)
        assert "1" in mbpoll(server.port, "-t", "0", "-r", "17", "-c", "1", "127.0.0.1").split("[17]:")[1]
        y = float(
            mbpoll(server.port, "-t", "3:float", "-B", "-r", "0", "-c", "1", "127.0.0.1").split("[0]:")[1].split()[0]
        )
        assert abs(y) < 1.0


def test_a_python_master_moves_and_reads_the_served_rig_on_a_serial_line() -> None:
    device = register_device()
    with SerialLine() as line, ModbusRig(device, RtuTransport(device=line.rig_device, parity="N")):
        master = minimalmodbus.Instrument(line.host_device, 1)
        master.serial.baudrate = 115200
        master.serial.timeout = 1.5  # a refusal is shorter than the answer it waits for
        master.write_registers(0, [250, 3])
        master.write_bit(17, 1)
        assert device.output == pytest.approx(0.25)
        assert master.read_register(2, functioncode=4) == 250
        assert master.read_bit(17, functioncode=1) == 1
        assert master.read_float(0, functioncode=4) == pytest.approx(device.plant.y_true, abs=0.05)
        master.write_float(10, 2.5, byteorder=minimalmodbus.BYTEORDER_BIG_SWAP)
        assert device.value["K"] == 2.5
        with pytest.raises(minimalmodbus.IllegalRequestError):
            master.read_register(99)
        master.serial.close()


@pytest.mark.parametrize("plant", ["ball", "servo", "two_tank", "thermal"])
def test_the_served_rig_refuses_what_is_no_number_and_goes_on(
    plant: Literal["ball", "servo", "two_tank", "thermal"],
) -> None:
    floats = {
        name: {"address": 2 * i, "type": "float32"} for i, name in enumerate(("u", "safe", "K", "Ti", "setpoint"))
    }
    given = floats | {"y": {"address": 100, "type": "float32"}, "enable": {"table": "coil", "address": 0}}
    device = register_device(RegisterMap.model_validate(given), make_plant(plant, seed=0))
    with ModbusRig(device, TcpTransport()) as server:
        master = ModbusClient(port=server.port, timeout=5.0)
        for wrong in (math.nan, math.inf, -math.inf):
            words = list(struct.unpack(">HH", struct.pack(">f", wrong)))
            for address in (0, 2, 4, 6, 8):
                assert not master.write_multiple_registers(address, words)
                assert master.last_except == 3
        assert master.write_multiple_registers(0, list(struct.unpack(">HH", struct.pack(">f", 3e38))))
        assert master.write_single_coil(0, True)
        assert device.by_host
        released = threading.Event()
        device.on_change = lambda change: released.set() if change.cause == "dead-man" else None
        assert released.wait(20.0)  # its time goes on
        assert master.read_holding_registers(100, 2) is not None
        assert master.write_multiple_registers(0, [0, 0])
        master.close()
