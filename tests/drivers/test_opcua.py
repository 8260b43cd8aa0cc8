"""Rigs behind an OPC UA server: the ball and the servo on a server of asyncua, secured, and what goes wrong there."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from autotune.cli.served import serve_opcua
from autotune.config import Config, load_config
from autotune.config.rig import OpcUaSettings
from autotune.errors import AutotuneError, InputError, LinkError
from autotune.text_files import read_toml
from drivers import open_rig
from drivers.gain_rig import GainRegisterRig
from drivers.kinds import kind_of
from drivers.opcua_rig import probe_kind
from tests.drivers.test_rig_commands import free_port

CONFIG = Path(__file__).parents[2] / "configs" / "ball_opcua.toml"


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return certificates_of_the_page(tmp_path_factory.mktemp("opcua"))


def certificates_of_the_page(folder: Path) -> Path:
    """Make the certificates with the commands of docs/opcua.md."""
    text = (Path(__file__).parents[2] / "docs" / "opcua.md").read_text()
    script = text.split("```sh\n")[1].split("```")[0]
    subprocess.run(["bash", "-euc", script], cwd=folder, check=True, capture_output=True, env=os.environ)
    return folder


def ball(folder: Path, *, secured: bool = True, **rig: Any) -> Config:
    """Return the shipped configuration with its certificates in a folder, on a free port, and changes to [rig]."""
    content = read_toml(CONFIG)
    table = content["rig"] | {"endpoint": f"opc.tcp://127.0.0.1:{free_port()}"}
    for place in (table, table["twin"]):
        for key in ("cert_file", "key_file", "server_cert_file"):
            if key in place:
                place[key] = str(folder / place[key])
    if not secured:
        table |= {"security_policy": "None"}
    content["rig"] = table | rig
    path = folder / "ball.toml"
    path.write_text(tomli_w.dumps(content))
    return load_config(path)


@contextmanager
def served_ball(config: Config, **given: Any) -> Iterator[tuple[GainRegisterRig, Any]]:
    """Serve the configuration's ball; yield the rig and the server."""
    assert isinstance(config.rig, OpcUaSettings)
    with serve_opcua(config, config.rig, **given) as server:
        rig = open_rig(config.rig, u_range=(0.0, 10.0), u_safe=0.0)
        assert isinstance(rig, GainRegisterRig)
        try:
            yield rig, server
        finally:
            rig.close()


def refused(config: Config, served: Config | None = None, **given: Any) -> str:
    """Return the one line with which a session is refused."""
    with served_ball(served or config, **given):
        rig = open_rig(config.rig, u_range=(0.0, 10.0), u_safe=0.0)
        with pytest.raises(AutotuneError) as error:
            rig.open()
        rig.close()
    assert "\n" not in str(error.value)
    return str(error.value)


def with_rig(config: Config, **changes: Any) -> Config:
    return config.model_copy(update={"rig": config.rig.model_copy(update=changes)})


def test_over_a_signed_and_encrypted_connection_the_host_commands_and_leaves_the_rig_safe(certificates: Path) -> None:
    with served_ball(ball(certificates)) as (rig, server):
        rig.open()
        rig.write(4.0)
        rig.clock.sleep_until(rig.clock.now() + 0.05)
        reading = rig.read()
        assert reading.u_applied == 4.0
        assert 0.0 <= reading.y <= 10.0
        assert not reading.suspect
        assert server.device.by_host
        first = reading.device_time_s
        rig.clock.sleep_until(rig.clock.now() + 0.2)
        assert 0.1 < rig.read().device_time_s - first < 1.0  # on the server's clock
        rig.make_safe()
        assert server.device.output == 0.0


def test_gains_are_handed_over_in_the_types_of_their_nodes(certificates: Path) -> None:
    config = ball(certificates)
    assert config.controller is not None
    with served_ball(config) as (rig, _):
        old = rig.read_gains()
        assert (old.K, old.Ti_s) == (pytest.approx(config.controller.K), config.controller.Ti_s)
        new = rig.holdable(old.__class__(K=-0.0247, Ti_s=3.6004))
        rig.write_gains(new)
        assert rig.read_gains() == new
        assert new.Ti_s == pytest.approx(3.6)


def test_a_host_that_falls_silent_leaves_the_device_to_its_dead_man(certificates: Path) -> None:
    with served_ball(ball(certificates, secured=False)) as (rig, server):
        rig.open()
        rig.write(4.0)
        rig.clock.sleep_until(rig.clock.now() + 0.8)
        server.device.live(server.now_s)
        assert server.device.output == 0.0
        with pytest.raises(LinkError, match="took the actuator back"):
            rig.read()


def test_a_server_that_restarts_is_met_by_a_new_session_and_the_sample_is_suspect(certificates: Path) -> None:
    config = ball(certificates, secured=False, timeout_s=2.0, retries=3)
    assert isinstance(config.rig, OpcUaSettings)
    link_config = config.rig
    with ExitStack() as stack:
        first = stack.enter_context(serve_opcua(config, link_config))
        rig: Any = open_rig(link_config, u_range=(0.0, 10.0), u_safe=0.0)
        rig._link.connect()
        assert not rig._ask()[0].suspect
        first.__exit__(None, None, None)
        stack.enter_context(serve_opcua(config, link_config))
        reading, _ = rig._ask()
        assert reading.suspect
        assert 0.0 <= reading.y <= 10.0
        rig.close()


def test_a_server_that_is_gone_is_an_error_and_never_a_sample(certificates: Path) -> None:
    config = ball(certificates, secured=False, timeout_s=0.5)
    with served_ball(config) as (rig, server):
        rig.open()
        server.__exit__(None, None, None)
        with pytest.raises(LinkError, match=r"OPC UA opc\.tcp://.*no (connection|answer)"):
            rig.read()
    with pytest.raises(LinkError, match="no connection"):
        open_rig(config.rig, u_range=(0.0, 10.0), u_safe=0.0).open()


def test_a_certificate_that_the_server_does_not_trust_is_named(certificates: Path, tmp_path: Path) -> None:
    config = ball(certificates)
    other = tmp_path / "other"
    other.mkdir()
    script = "openssl req -x509 -newkey rsa:2048 -nodes -days 9 -keyout x.key -out x.pem -subj /CN=x -addext {}"
    san = "subjectAltName=URI:urn:autotune:x,DNS:localhost"
    subprocess.run(["bash", "-euc", script.format(san)], cwd=other, check=True, capture_output=True)
    stranger = with_rig(config, cert_file=str(other / "x.pem"), key_file=str(other / "x.key"))
    said = refused(stranger, served=config)
    assert "certificate" in said
    assert "trust" in said


def test_a_wrong_password_is_named_and_the_right_one_is_let_in(certificates: Path, tmp_path: Path) -> None:
    password = tmp_path / "password"
    password.write_text("wrong\n")
    config = ball(certificates, user="operator", password_file=str(password))
    assert "the server refuses the user or the password" in refused(config, users={"operator": "right"})
    password.write_text("right\n")
    with served_ball(config, users={"operator": "right"}) as (rig, _):
        rig.open()
        rig.make_safe()


@pytest.mark.parametrize(
    ("nodes", "served_nodes", "named"),
    [
        ({"y": "ns=2;s=Ball.z"}, {}, "node of y does not exist"),
        ({"y": "2:Ball/2:nothing"}, {}, "node of y is not found by its browse names"),
        ({"u": "ns=2;s=Ball.y"}, {}, "node of u is read-only"),
        ({}, {"u": {"node": "ns=2;s=Ball.u", "type": "int16", "scale": 1e-3}}, "node of u holds Int16, not float64"),
        ({"heartbeat": "ns=2;s=Ball.u"}, {}, "node of heartbeat holds Double, not uint16"),
    ],
)
def test_a_node_that_is_not_as_it_is_mapped_is_named_before_anything_is_written(
    certificates: Path, nodes: dict[str, Any], served_nodes: dict[str, Any], named: str
) -> None:
    config = ball(certificates, secured=False)
    assert isinstance(config.rig, OpcUaSettings)
    given = config.rig.nodes.model_dump(exclude_none=True)
    kind = type(config.rig.nodes)
    host = with_rig(config, nodes=kind.model_validate(given | nodes))
    served = with_rig(config, nodes=kind.model_validate(given | served_nodes))
    assert named in refused(host, served=served)


def test_nodes_are_found_by_browse_names_too(certificates: Path) -> None:
    config = ball(certificates, secured=False)
    assert isinstance(config.rig, OpcUaSettings)
    given = config.rig.nodes.model_dump(exclude_none=True)
    named = with_rig(config, nodes=type(config.rig.nodes).model_validate(given | {"y": "2:Ball/2:y"}))
    with served_ball(config):
        rig = open_rig(named.rig, u_range=(0.0, 10.0), u_safe=0.0)
        rig.open()
        assert 0.0 <= rig.read().y <= 10.0
        rig.make_safe()
        rig.close()


def test_probe_reads_every_node_once_and_writes_nothing(certificates: Path) -> None:
    config = ball(certificates, secured=False)
    assert isinstance(config.rig, OpcUaSettings)
    with served_ball(config) as (_, server):
        found = probe_kind(config.rig, {"y": (5.0, 9.0)})
        assert {one.name for one in found.signals} == set(config.rig.nodes.mapped())
        assert [one.name for one in found.signals if one.warnings] == ["y"]
        assert re.search(r"; a sample takes .* sample times from [125]0* ms on$", found.description)
        assert not server.device.by_host
        assert server.device.value["heartbeat"] == 0.0
    reach = kind_of(config.rig).reach_of(config.rig)
    assert reach.address is not None
    assert len(reach.files) == 3


def test_what_belongs_together_is_asked_for(certificates: Path) -> None:
    config = ball(certificates)
    for change, reason in (
        ({"key_file": None}, "needs key_file"),
        ({"user": "x"}, "user and password_file belong together"),
        ({"endpoint": "http://x"}, "endpoint"),
    ):
        table = config.rig.model_dump(exclude_none=True) | change
        with pytest.raises(ValueError, match=reason):
            OpcUaSettings.model_validate({key: value for key, value in table.items() if value is not None})
    missing = with_rig(config, cert_file=str(certificates / "none.pem"))
    with pytest.raises(InputError, match=r"none\.pem: no such file"):
        open_rig(missing.rig, u_range=(0.0, 10.0), u_safe=0.0).open()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_run_on_the_secured_server_is_accepted_and_kept_by_the_device(certificates: Path, tmp_path: Path) -> None:
    from autotune.pipeline import tune

    config = ball(certificates)
    with served_ball(config) as (rig, server):
        tuning = tune(rig, config, tmp_path)
        assert tuning.verification is not None
        assert tuning.verification.accepted, tuning.verification.reason
        assert tuning.verification.by == "device"
        assert server.device.value["K"] == pytest.approx(tuning.analysis.controller.K, rel=1e-6)
