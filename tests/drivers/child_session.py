"""A session in a process of its own, for the tests that stop or starve it: ``JSON RECORDING.csv [BYTES]``."""

from __future__ import annotations

import json
import resource
import sys

from autotune.config.procedure import LimitSettings
from autotune.config.rig import ModbusTcpSettings
from autotune.errors import AutotuneError
from autotune.experiment.limits import Envelope
from autotune.experiment.loop import ControlLoop
from autotune.recording import RecordingWriter
from drivers import open_rig
from tests.drivers.campaign import SAMPLE_S


def main() -> None:
    """Run a relay until something stops it; no file may grow beyond the bytes, as on a disk that is full."""
    if len(sys.argv) > 3:
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
    asked = json.loads(sys.argv[1])
    limits, (level, above, below) = LimitSettings.model_validate(asked["limits"]), asked["relay"]
    settings = ModbusTcpSettings.model_validate(asked["rig"])
    rig = open_rig(settings, u_range=(limits.u_min, limits.u_max), u_safe=limits.u_safe)
    envelope = Envelope(settings=limits, sample_time_s=SAMPLE_S)
    try:
        with ControlLoop(rig=rig, envelope=envelope, writer=RecordingWriter(sys.argv[2], ("t", "u", "y"), {})) as loop:
            tick = loop.tick
            while True:
                tick = loop.step(loop.nearest(above if tick.y > level else below))
    except AutotuneError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(error.exit_status)


if __name__ == "__main__":
    main()
