"""The driver against the compiled program on a PLC that scans: run, verify, deploy, kill -9 and the next run."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from autotune.config.registers import RegisterMap
from autotune.controller import PIDController
from drivers import open_rig
from tests.drivers.bench import LIMIT_S, tcp_settings
from tests.drivers.scanned_plc import Lags, ScannedPlc
from tests.drivers.test_structured_text import documented_map

pytestmark = pytest.mark.system("gcc")
ROOT = Path(__file__).resolve().parents[2]


def configuration(plc: ScannedPlc, folder: Path) -> Path:
    """Write a configuration with the documented map, the sample two scans long."""
    T_s = 2.0 * plc.scan_s
    content: dict[str, Any] = {
        "name": "plc",
        "rig": {
            "kind": "modbus_tcp",
            "port": plc.port,
            "scan_time_s": plc.scan_s,
            "registers": documented_map(),
            "timeout_s": 2.0,
        },
        "signals": {"sample_time_s": T_s, "u_unit": "V", "y_unit": "V"},
        "limits": {
            "u_min": 0.0, "u_max": 10.0, "u_safe": 1.0, "y_min": 0.5, "y_max": 9.5, "swing": 3.0, "time_s": 300.0,
        },
        "operating_point": {
            "y": 5.0, "u_guess": 5.0, "u_uncertainty": 0.5, "approach": "ramp", "ramp_rate": 0.04 / plc.scan_s,
        },
        "experiment": {"budget_s": 1000.0 * T_s, "points": 3, "gain_sd": 0.02},
        "design": {"noise_gain": 20.0},
    }  # fmt: skip
    path = folder / "plc.toml"
    path.write_text(tomli_w.dumps(content))
    return path


def autotune(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "autotune.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


CHILD = """
import sys
from autotune.config.registers import RegisterMap
from tests.drivers.bench import tcp_settings
from tests.drivers.test_structured_text import documented_map
from drivers import open_rig

registers = RegisterMap.model_validate(documented_map())
settings = tcp_settings(int(sys.argv[1]), registers, scan_time_s=float(sys.argv[2]))
rig = open_rig(settings, u_range=(0.0, 10.0), u_safe=1.0)
rig.open()
while True:
    rig.write(4.0)
    rig.read()
"""


@pytest.mark.parametrize("scan_s", [0.02, 0.1])
def test_a_killed_host_leaves_the_safe_output_and_the_next_one_takes_command(tmp_path: Path, scan_s: float) -> None:
    registers = RegisterMap.model_validate(documented_map())
    with ScannedPlc(Lags((0.4, 0.1)), tmp_path, scan_s) as plc:
        child = subprocess.Popen([sys.executable, "-c", CHILD, str(plc.port), str(scan_s)], cwd=ROOT)
        plc.until(lambda: plc.output > 3.9, "the host commands")
        child.kill()
        assert child.wait(LIMIT_S) == -signal.SIGKILL
        plc.until(lambda: plc.output == pytest.approx(1.0, abs=1e-3), "the dead-man acts")
        plc.until(lambda: plc.written("MW3") == 0.0, "the program clears what the dead host left")
        settings = tcp_settings(plc.port, registers, scan_time_s=scan_s, timeout_s=2.0)
        rig: Any = open_rig(settings, u_range=(0.0, 10.0), u_safe=1.0)
        rig.open()
        for u in (2.0, 3.0):
            rig.write(u)
            plc.until(lambda u=u: plc.output == pytest.approx(u, abs=1e-3), "the next host commands")
            assert rig.read().y < 10.0
        rig.make_safe()
        plc.until(lambda: plc.output == pytest.approx(1.0, abs=1e-3), "safe")
        rig.write_gains(PIDController(K=2.5, Ti_s=1.25))
        assert rig.read_gains() == PIDController(K=2.5, Ti_s=1.25)
        rig.close()


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("scan_s", [0.02, 0.1])
def test_a_loop_on_a_scanned_plc_is_commissioned(tmp_path: Path, scan_s: float) -> None:
    """Time constants grow with the scan, so that the loop is the same in scans."""
    with ScannedPlc(Lags((20.0 * scan_s, 5.0 * scan_s)), tmp_path / "plc", scan_s) as plc:
        config = configuration(plc, tmp_path)
        first = tmp_path / "first"
        done = autotune("run", config, "--out", first)
        assert (done.returncode, "the rig holds it now" in done.stdout) == (0, True), done.stderr
        held = json.loads((first / "result.json").read_text())["controller"]
        assert plc.written("MD4") == pytest.approx(held["K"], rel=1e-6)
        assert plc.written("MD5") == pytest.approx(held["Ti_s"], rel=1e-6)
        for command in (["verify"], ["deploy", "--yes"]):
            done = autotune(command[0], config, "--run", first, *command[1:])
            assert done.returncode == 0, done.stdout + done.stderr
        rests = 1.1  # a run is refused while the plant still moves at the safe output
        plc.until(lambda: plc.written("MD0") < rests, "the plant comes to rest")
        second = tmp_path / "second"
        command = [sys.executable, "-m", "autotune.cli", "run", str(config), "--out", str(second)]
        killed = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        plc.until(lambda: plc.output > 3.0, "the run is on its way", limit_s=4.0 * LIMIT_S)
        killed.kill()
        killed.wait(LIMIT_S)
        plc.until(lambda: plc.output == pytest.approx(1.0, abs=1e-3), "the dead-man acts")
        plc.until(lambda: plc.written("MD0") < rests, "the plant comes to rest")
        done = autotune("run", config, "--out", tmp_path / "third")
        assert done.returncode == 0, done.stderr
        assert plc.output == pytest.approx(1.0, abs=1e-3)
