"""Are margins kept on the plant that a recording was made from? Three plants, open and closed loop, two noises.

``RECORDS=0:10`` in the environment says which records of each kind are fitted and designed on, 0 to 9 by default. Each
row says how many were designed and refused, on how many the true plant misses a margin by more than half a per cent,
the worst, and how far fits are off where a margin looks: the root mean square of the true plant's distance from the fit
along the margin nearest to its limit, in standard deviations.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from itertools import product

import numpy as np

from autotune.config.procedure import DesignSettings
from autotune.design.members import members_of
from autotune.design.on_fit import design_on_fit
from autotune.errors import AutotuneError
from autotune.models import TransferFunction
from autotune.pipeline import measure_plant
from autotune.pipeline.analysis import specification
from autotune.recording import Recording
from tests.benchmarks._front_door_files import EXCHANGER, OVEN, TANK, Rows, closed_loop, levels, open_loop

_MISSED = 0.005
_POLE = 0.8
_MOVES = levels(1.0, (100.0, 0.0), (400.0, 5.0), (400.0, -2.0), (300.0, 3.0))
#: each plant's commands in open loop, PI in closed loop, and noise
_PLANTS: dict[str, tuple[TransferFunction, tuple[tuple[float, float], ...], tuple[float, float], float]] = {
    "oven": (OVEN, ((60.0, 0.0), (90.0, 10.0), (90.0, -10.0), (300.0, 0.0)), (1.5, 60.0), 0.1),
    "exchanger": (EXCHANGER, ((60.0, 0.0), *((200.0, u) for u in (5.0, 10.0, 15.0, 10.0, 5.0, 0.0))), (0.4, 60.0), 0.1),
    "tank": (TANK, ((60.0, 0.0), *((120.0, u) for u in (10.0, -10.0, 0.0, -8.0, 8.0, 0.0))), (12.0, 80.0), 0.03),
}


def records(plant: str, loop: str, pole: float) -> Callable[[int], Recording]:
    """Return what makes a record of a number."""
    H, steps, (K, Ti), noise = _PLANTS[plant]

    def make(seed: int) -> Recording:
        if loop == "closed":
            rows = closed_loop(H, _MOVES, 1.0, K, Ti, noise, 50.0, 40.0, seed, pole)
        else:
            rows = open_loop(H, levels(1.0, *steps), 1.0, noise, 50.0, 30.0, seed, pole)
        return _recording(rows)

    return make


def _recording(rows: Rows) -> Recording:
    extra = {} if rows.r is None else {"r": rows.r}
    return Recording(t=rows.t, u=rows.u, y=rows.y, extra=extra)


def kept(plant: TransferFunction, recording: Recording) -> tuple[float, float]:
    """Return the true plant's least relative slack under the design on a recording, and its distance from the fit."""
    measured = measure_plant([recording])
    assert measured.fit is not None
    asked, _ = specification(DesignSettings(), measured.fit, measured.facts, 0.2 * math.pi)
    controller = design_on_fit(measured.fit, asked).controller
    border = members_of(measured.fit.border(asked.distance), asked).slacks(controller, asked).min(axis=0)
    there, fitted = members_of((plant, measured.fit.plant), asked).slacks(controller, asked)
    nearest = int(np.argmin(border))
    sd = max(float(fitted[nearest] - border[nearest]), 1e-12) / asked.distance
    return float(np.min(there)), float(there[nearest] - fitted[nearest]) / sd


def main() -> None:
    """Print a row for each kind of record, and one for all."""
    first, last = (int(one) for one in os.environ.get("RECORDS", "0:10").split(":"))
    print("| plant | loop | noise's pole | designed | refused | missed | worst slack | error over sd |")
    print("|---|---|---|---|---|---|---|---|")
    every: list[tuple[float, float]] = []
    for plant, loop, pole in product(_PLANTS, ("open", "closed"), (0.0, _POLE)):
        make, found, refused = records(plant, loop, pole), [], 0
        for seed in range(first, last):
            try:
                found.append(kept(_PLANTS[plant][0], make(seed)))
            except AutotuneError:
                refused += 1
        every += found
        print(f"| {plant} | {loop} | {pole:g} | {_row(found, refused)}", flush=True)
    print(f"| all | | | {_row(every, 0)}")


def _row(found: list[tuple[float, float]], refused: int) -> str:
    slack, distance = np.array(found).T
    rms = float(np.sqrt(np.mean(distance**2)))
    return f"{len(found)} | {refused} | {int(np.sum(slack < -_MISSED))} | {slack.min():.3f} | {rms:.2f} |"


if __name__ == "__main__":
    main()
