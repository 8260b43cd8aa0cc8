"""OPC UA against a server that is nobody's code here: node-opcua, where NODE_PATH has it (npm install node-opcua)."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from autotune.config import Config, load_config
from autotune.errors import AutotuneError, LinkError
from autotune.pipeline import tune
from drivers import open_rig
from tests.drivers.test_opcua import certificates_of_the_page
from tests.drivers.test_rig_commands import free_port

SERVER = Path(__file__).with_name("node_opcua_server.js")


@contextmanager
def serving(folder: Path, port: int) -> Iterator[None]:
    """Serve the controller until the context ends, which is a power failure to it."""
    node = shutil.which("node")
    assert node is not None
    with subprocess.Popen([node, SERVER, str(port), str(folder)], stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            assert any(line.startswith("ready") for line in server.stdout)
            yield
        finally:
            server.kill()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with certificates, where there is a node-opcua to use them."""
    node = shutil.which("node")
    if node is None or subprocess.run([node, "-e", 'require("node-opcua")'], capture_output=True).returncode:
        pytest.skip("needs node with node-opcua: npm install node-opcua, and NODE_PATH to its node_modules")
    return certificates_of_the_page(tmp_path_factory.mktemp("node"))


@pytest.fixture(scope="module")
def served(made: Path) -> Iterator[tuple[Path, int]]:
    """Serve the controller; return the folder of certificates and the port."""
    port = free_port()
    with serving(made, port):
        yield made, port


def described(served: tuple[Path, int], folder: Path, password: str = "right", **nodes: Any) -> Config:
    """Return a configuration of it."""
    made, port = served
    (folder / "password").write_text(f"{password}\n")
    names = ("y", "u_applied", "heartbeat_echo", "in_command", "u", "heartbeat", "safe", "enable", "automatic")
    signals = {name: f"ns=1;s={name}" for name in (*names, "setpoint", "load", "Ti")}
    content: dict[str, Any] = {
        "name": "node-opcua",
        "rig": {
            "kind": "opcua", "endpoint": f"opc.tcp://127.0.0.1:{port}/rig", "timeout_s": 3.0, "scan_time_s": 0.01,
            "cert_file": str(made / "certificates" / "host.pem"), "key_file": str(made / "certificates" / "host.key"),
            "server_cert_file": str(made / "pki" / "own" / "certs" / "certificate.pem"),
            "user": "operator", "password_file": str(folder / "password"),
            "nodes": signals | {"K": {"node": "ns=1;s=K", "type": "float32"}} | nodes,
        },
        "signals": {"sample_time_s": 0.05, "u_unit": "V", "y_unit": "V"},
        "limits": {"u_min": 0.0, "u_max": 10.0, "u_safe": 4.5, "y_min": 0.2, "y_max": 9.5, "swing": 2.0,
                   "time_s": 240.0, "late_s": 1.0},
        "operating_point": {"y": 5.0, "u_guess": 5.0, "u_uncertainty": 1.0, "approach": "hold"},
        "experiment": {"budget_s": 60.0, "points": 3},
    }  # fmt: skip
    path = folder / "rig.toml"
    path.write_text(tomli_w.dumps(content))
    return load_config(path)


def rig_of(config: Config) -> Any:
    return open_rig(config.rig, u_range=(0.0, 10.0), u_safe=4.5)


def test_the_host_commands_reads_back_and_leaves_it_safe(served: tuple[Path, int], tmp_path: Path) -> None:
    rig = rig_of(described(served, tmp_path))
    rig.open()
    rig.write(6.0)
    rig.clock.sleep_until(rig.clock.now() + 0.1)
    reading = rig.read()
    assert reading.u_applied == 6.0
    assert not reading.suspect
    rig.make_safe()
    rig.close()
    assert rig.read_gains().K > 0.0
    rig.close()


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"password": "wrong"}, "the server refuses the user or the password"),
        ({"y": "ns=1;s=z"}, "node of y does not exist"),
        ({"u": "ns=1;s=y"}, "node of u is read-only"),
        ({"heartbeat": "ns=1;s=u"}, "node of heartbeat holds Double, not uint16"),
    ],
)
def test_what_is_wrong_is_named(served: tuple[Path, int], tmp_path: Path, given: dict[str, Any], named: str) -> None:
    rig = rig_of(described(served, tmp_path, **given))
    with pytest.raises(AutotuneError) as error:
        rig.open()
    rig.close()
    assert isinstance(error.value, LinkError)
    assert named in str(error.value)


def test_a_certificate_that_the_server_does_not_trust_is_named(served: tuple[Path, int], tmp_path: Path) -> None:
    made, port = served
    stranger = certificates_of_the_page(tmp_path) / "certificates"
    config = described((made, port), tmp_path)
    files = {"cert_file": str(stranger / "host.pem"), "key_file": str(stranger / "host.key")}
    rig = rig_of(config.model_copy(update={"rig": config.rig.model_copy(update=files)}))
    with pytest.raises(LinkError, match=r"the server (does not trust|refuses) this host's certificate") as error:
        rig.open()
    rig.close()
    assert "among the certificates that the server trusts" in str(error.value)


def test_a_type_that_the_server_refuses_in_a_write_is_named(served: tuple[Path, int], tmp_path: Path) -> None:
    rig = rig_of(described(served, tmp_path, Ti={"node": "ns=1;s=Ti", "type": "float32"}))
    with pytest.raises(LinkError, match="node of Ti holds Double, not float32") as error:
        rig.read_gains()
    rig.close()
    assert 'its type = "float64"' in str(error.value)


def test_after_a_restart_of_the_server_the_rig_is_not_commanded_any_more(made: Path, tmp_path: Path) -> None:
    port = free_port()
    with serving(made, port):
        config = described((made, port), tmp_path)
        rig = rig_of(config.model_copy(update={"rig": config.rig.model_copy(update={"retries": 3})}))
        rig.open()
        rig.write(6.0)
    with serving(made, port):
        with pytest.raises(LinkError, match=r"took the actuator back|echoes heartbeat") as error:
            rig.read()
        assert "\n" not in str(error.value)
        rig.make_safe()
        assert rig._ask()[0].u_applied == 4.5
        rig.close()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_run_is_accepted_and_kept(served: tuple[Path, int], tmp_path: Path) -> None:
    rig = rig_of(config := described(served, tmp_path))
    out = tmp_path / "out"
    out.mkdir()
    tuning = tune(rig, config, out)
    assert tuning.verification is not None
    assert tuning.verification.accepted, tuning.verification.reason
    assert (tuning.verification.by, tuning.deployed) == ("device", True)
    assert pytest.approx(tuning.analysis.controller.K, rel=1e-6) == rig.read_gains().K
    rig.close()
