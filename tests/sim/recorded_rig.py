"""A rig's folder for tests: a servo's model and recordings of a servo whose numbers differ from it."""

import numpy as np
from scipy.signal import lsim

MODEL = """name = "servo"
[input]
unit = "V"
offset = 0.5
[output]
unit = "rad"
offset = 1.0
[[block]]
name = "drive"
place = "actuator"
num = [1.0]
den = [0.05, 1.0]
[[block]]
name = "body"
place = "plant"
num = [2.0]
den = [0.3, 1.0]
"""
TS = 0.02
NOISE = 0.02


def record(seed, rows=1500, gain=2.2):
    """Rows of one recording: random levels through the servo, with noise."""
    rng = np.random.default_rng(seed)
    u = 0.5 + np.cumsum(rng.normal(0.0, 0.05, rows)) * 0.2 + np.repeat(rng.uniform(-1, 1, rows // 50), 50)
    t = np.arange(rows) * TS
    fine = np.arange(rows * 10) * TS / 10
    y = lsim(([gain], [0.05 * 0.3, 0.35, 1.0]), np.repeat(u - 0.5, 10), fine, interp=False)[1][::10]
    return t, u, 1.0 + y + rng.normal(0.0, NOISE, rows)


def write_recording(path, t, u, y, header="t,u,y"):
    """Write one recording."""
    np.savetxt(path, np.column_stack([t, u, y]), fmt="%.9g", delimiter=",", header=header, comments="")


def write_rig(folder, rows=1500):
    """Write the rig's folder: model, one recording that is given and one that is kept back."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.toml").write_text(MODEL)
    write_recording(folder / "fit.csv", *record(1, rows))
    write_recording(folder / "test.csv", *record(2, rows))
    return folder
