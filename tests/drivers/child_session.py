"""A session in a process of its own, for the tests that stop or starve it: ``PORT RECORDING.csv [BYTES]``."""

from __future__ import annotations

import resource
import sys

from autotune.errors import AutotuneError
from autotune.experiment.limits import Envelope
from autotune.experiment.loop import ControlLoop
from autotune.recording import RecordingWriter
from drivers import open_rig
from tests.drivers.bench import U_SAFE, tcp_settings
from tests.drivers.campaign import SAMPLE_S
from tests.drivers.lines import LIMITS


def main() -> None:
    """Run a relay until something stops it; no file may grow beyond the bytes, as on a disk that is full."""
    if len(sys.argv) > 3:
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
    rig = open_rig(tcp_settings(int(sys.argv[1])), u_range=(LIMITS.u_min, LIMITS.u_max), u_safe=U_SAFE)
    envelope = Envelope(settings=LIMITS, sample_time_s=SAMPLE_S)
    try:
        with ControlLoop(rig=rig, envelope=envelope, writer=RecordingWriter(sys.argv[2], ("t", "u", "y"), {})) as loop:
            tick = loop.tick
            while True:
                tick = loop.step(loop.nearest(-0.4 if tick.y > 0.0 else 0.4))
    except AutotuneError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(error.exit_status)


if __name__ == "__main__":
    main()
