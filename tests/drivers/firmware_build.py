"""Builds of the firmware: its portable part for this computer, the whole for the microcontroller."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path

import numpy as np

from autotune.arrays import FloatArray
from autotune.design.law import PILaw
from autotune.experiment.relay import RelaySettings

FIRMWARE = Path(__file__).parents[2] / "drivers" / "firmware"
_PORTABLE = ("device.c", "frame.c", "relay.c", "pi.c")
_SHIM = """
#include <stdlib.h>
#include "device.h"
#include "frame.h"
int relay_run(const double *s, int smoothing, int sign, const double *y, double *u, int n)
{
    const relay_settings settings = {s[0], s[1], s[2], s[3], s[4], smoothing, sign};
    relay_state state;
    real out;
    relay_start(&state);
    if (!relay_accepts(&settings))
        return -1;
    for (int k = 0; k < n; k++) {
        if (!relay_step(&state, &settings, y[k], &out))
            return k;
        u[k] = out;
    }
    return n;
}
void pi_run(const double *s, double u_held, double r, const double *y, double *u, int n)
{
    const pi_settings settings = pi_of(s[0], s[1], s[2], s[3], s[4], s[5]);
    pi_state state;
    pi_start(&state, &settings, u_held, r, y[0]);
    for (int k = 0; k < n; k++)
        u[k] = pi_step(&state, &settings, r, y[k]);
}
device *device_new(void)
{
    const device_setup setup = {1000, 1023, 16000, 0, 1, 0};
    device *d = malloc(sizeof *d);
    device_start(d, &setup);
    return d;
}
"""


class PortableFirmware:
    """The portable part as a library of this computer.

    Parameters
    ----------
    folder : Path
        Where it is built.
    real : {"double", "float"}
        The laws' numbers.
    """

    def __init__(self, folder: Path, real: str) -> None:
        shim, library = folder / "shim.c", folder / f"firmware_{real}.so"
        shim.write_text(_SHIM)
        sources = [FIRMWARE / name for name in _PORTABLE]
        flags = ["-std=c11", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
        command = ["gcc", *flags, f"-DREAL={real}", f"-I{FIRMWARE}", "-o", library, shim, *sources]
        subprocess.run(command, check=True)
        self.library = ctypes.CDLL(str(library))
        self.library.device_new.restype = ctypes.c_void_p

    def relay_outputs(self, settings: RelaySettings, y: FloatArray) -> FloatArray:
        """Return the relay's outputs, (N,); shorter where it could not remember its decisions."""
        s = settings
        numbers = np.array([s.y_centre, s.midpoint, s.amplitude, s.hysteresis, s.delay_samples])
        u = np.empty(len(y))
        done = self.library.relay_run(_p(numbers), s.smoothing, s.plant_sign, _p(y), _p(u), len(y))
        assert done >= 0
        return u[:done]

    def pi_outputs(self, law: PILaw, y: FloatArray, r: float, u_held: float) -> FloatArray:
        """Return the law's outputs, (N,)."""
        c, T_s = law.controller, law.sample_time_s
        numbers = np.array([c.K, min(c.Ti_s, 1e30), T_s, law.u_min, law.u_max, min(law.u_rate * T_s, 1e30)])
        u = np.empty(len(y))
        self.library.pi_run(_p(numbers), ctypes.c_double(u_held), ctypes.c_double(r), _p(y), _p(u), len(y))
        return u


def _p(values: FloatArray) -> ctypes.c_void_p:
    return values.ctypes.data_as(ctypes.c_void_p)


def build_uno(folder: Path) -> Path:
    """Build the firmware of the Arduino Uno; return its .elf, beside which lies the .hex."""
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(["make", "-s", "-C", FIRMWARE, f"OUT={folder}"], check=True, capture_output=True)
    return folder / "uno.elf"
