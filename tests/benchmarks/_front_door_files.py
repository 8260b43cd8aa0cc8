"""Recordings as people have them, made anew from five plants that are known: one file per habit of a plant floor."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from autotune.arrays import FloatArray
from autotune.models import TransferFunction

OVEN = TransferFunction(num=(0.80,), den=(90.0, 1.0), delay_s=8.1)
EXCHANGER = TransferFunction(num=(1.6,), den=(360.0, 42.0, 1.0), delay_s=5.0)
BOILER = TransferFunction(num=(-6.0, 1.2), den=(200.0, 30.0, 1.0), delay_s=2.0)
SERVO = TransferFunction(num=(2.0,), den=(0.04, 0.06, 1.0), delay_s=0.05)
TANK = TransferFunction(num=(0.004,), den=(6.0, 1.0, 0.0), delay_s=3.0)


@dataclass(frozen=True, kw_only=True)
class Rows:
    """What a file holds: time [s], set-point or None, command, measurement."""

    t: FloatArray
    u: FloatArray
    y: FloatArray
    r: FloatArray | None = None


@dataclass(frozen=True, kw_only=True)
class Door:
    """A file that comes to the front door, and the plant that it was made from."""

    name: str
    plant: TransferFunction
    write: Callable[[Path], None]


class _Plant:
    """The plant under a held command, stepped exactly; its own equations, not those of the tool."""

    def __init__(self, plant: TransferFunction, step_s: float) -> None:
        den = np.array(plant.den) / plant.den[0]
        num = np.concatenate([np.zeros(den.size - len(plant.num)), np.array(plant.num) / plant.den[0]])
        n = den.size - 1
        A = np.zeros((n + 1, n + 1))
        A[: n - 1, 1:n] = np.eye(n - 1)
        A[n - 1, :n], A[n - 1, n] = -den[:0:-1], 1.0
        self._whole, self._c = expm(A * step_s), num[:0:-1]
        self._n, self._late = n, plant.delay_s / step_s
        part = self._late - int(self._late)
        self._first, self._second = expm(A * step_s * part), expm(A * step_s * (1.0 - part))
        self._held = [0.0] * (int(self._late) + 2)
        self._x = np.zeros(n)

    def output(self) -> float:
        """Return y now, before the next command acts."""
        return float(self._c @ self._x)

    def hold(self, u: float) -> None:
        """Hold a command for one step; what acts meanwhile was given a dead time ago."""
        self._held = [u, *self._held[:-1]]
        for transition, held in ((self._first, self._held[-1]), (self._second, self._held[-2])):
            self._x = (transition @ np.append(self._x, held))[: self._n]


def open_loop(
    plant: TransferFunction, u: FloatArray, step_s: float, noise: float, y_0: float, u_0: float, seed: int,
    pole: float = 0.0,
) -> Rows:  # fmt: skip
    """Return a record of a plant under commands; ``pole`` is that of the sensor's noise from row to row."""
    rng, model = np.random.default_rng(seed), _Plant(plant, step_s)
    y = np.empty(u.size)
    for k, value in enumerate(u):
        y[k] = model.output()
        model.hold(value)
    white = math.sqrt(1.0 - pole**2) * rng.standard_normal(u.size)
    of_sensor = white if pole == 0.0 else lfilter([1.0], [1.0, -pole], white)
    y = y_0 + y + noise * of_sensor
    return Rows(t=step_s * np.arange(u.size), u=u_0 + u, y=y)


def closed_loop(
    plant: TransferFunction, r: FloatArray, step_s: float, K: float, Ti: float, noise: float, y_0: float, u_0: float,
    seed: int, pole: float = 0.0,
) -> Rows:  # fmt: skip
    """Return a record of a loop under a PI that moves its set-point; process noise is a slow first-order load.

    ``pole`` is that of the sensor's noise from row to row.
    """
    rng, model = np.random.default_rng(seed), _Plant(plant, step_s)
    u, y, total, load, of_sensor = np.empty(r.size), np.empty(r.size), 0.0, 0.0, 0.0
    for k, wanted in enumerate(r):
        of_sensor = pole * of_sensor + math.sqrt(1.0 - pole**2) * rng.standard_normal()
        y[k] = model.output() + noise * of_sensor
        error = wanted - y[k]
        total += K * step_s / Ti * error
        u[k] = K * error + total
        load = 0.98 * load + 0.2 * noise * rng.standard_normal()
        model.hold(u[k] + load)
    return Rows(t=step_s * np.arange(r.size), u=u_0 + u, y=y_0 + y, r=y_0 + r)


def levels(step_s: float, *pieces: tuple[float, float]) -> FloatArray:
    """Return levels held for so many seconds each: (seconds, level), ..."""
    return np.concatenate([np.full(round(seconds / step_s), level) for seconds, level in pieces])


def _oven_step() -> Rows:
    u = levels(1.0, (60.0, 0.0), (540.0, 20.0))
    return open_loop(OVEN, u, 1.0, 0.1, 22.0, 30.0, 1)


def _doublet() -> Rows:
    u = levels(1.0, (60.0, 0.0), (90.0, 10.0), (90.0, -10.0), (300.0, 0.0))
    return open_loop(OVEN, u, 1.0, 0.1, 60.0, 40.0, 2)


def _staircase() -> Rows:
    u = levels(1.0, (60.0, 0.0), *((200.0, level) for level in (5.0, 10.0, 15.0, 10.0, 5.0, 0.0)))
    return open_loop(EXCHANGER, u, 1.0, 0.15, 50.0, 30.0, 3)


def _loop() -> Rows:
    r = levels(1.0, (100.0, 0.0), (400.0, 5.0), (400.0, -2.0), (300.0, 3.0))
    return closed_loop(EXCHANGER, r, 1.0, 0.4, 60.0, 0.1, 50.0, 40.0, 4)


def _historian() -> Rows:
    u = levels(1.0, (60.0, 0.0), *((40.0 + 20.0 * (i % 3), 6.0 * (i % 2)) for i in range(12)))
    return open_loop(BOILER_FEED, u, 1.0, 0.05, 30.0, 50.0, 5)


def _pid_block() -> Rows:
    r = levels(0.5, (60.0, 0.0), (240.0, 6.0), (240.0, -3.0), (240.0, 4.0))
    return closed_loop(EXCHANGER, r, 0.5, 0.5, 50.0, 0.08, 50.0, 40.0, 6)


def _inverse() -> Rows:
    u = levels(1.0, (40.0, 0.0), *((90.0, level) for level in (8.0, 0.0, -8.0, 0.0, 8.0, 0.0)))
    return open_loop(BOILER, u, 1.0, 0.05, 100.0, 50.0, 7)


def _servo() -> Rows:
    u = levels(0.02, (1.0, 0.0), *((6.0, level) for level in (1.0, 0.0, -1.0, 0.0)))
    return open_loop(SERVO, u, 0.02, 0.02, 0.0, 0.0, 8)


def _tank() -> Rows:
    u = levels(1.0, (60.0, 0.0), (120.0, 10.0), (120.0, -10.0), (120.0, 0.0), (100.0, -8.0), (100.0, 8.0), (100.0, 0.0))
    return open_loop(TANK, u, 1.0, 0.03, 50.0, 45.0, 9)


def _milliamps() -> Rows:
    u = levels(0.1, (5.0, 0.0), *((6.0 + 3.0 * (i % 4), 10.0 * (i % 2)) for i in range(10)))
    return open_loop(PRESSURE, u, 0.1, 0.01, 12.0, 50.0, 10)


def _long() -> Rows:
    rng = np.random.default_rng(11)
    u = np.repeat(rng.choice([-4.0, 4.0], 1000), 200)
    return open_loop(EXCHANGER, u, 0.5, 0.2, 50.0, 40.0, 11)


#: fast beside its historian: one row a second
BOILER_FEED = TransferFunction(num=(1.5,), den=(6.0, 1.0), delay_s=1.5)
PRESSURE = TransferFunction(num=(0.08,), den=(2.0, 1.0), delay_s=0.4)


def _text(
    make: Callable[[], Rows], header: str, *, delimiter: str = ",", order: str = "tuy", decimal: str = ".",
    encoding: str = "utf-8", time_scale: float = 1.0, digits: int = 4,
) -> Callable[[Path], None]:  # fmt: skip
    def write(path: Path) -> None:
        rows = make()
        columns = [time_scale * rows.t if name == "t" else getattr(rows, name) for name in order]
        lines = [delimiter.join(f"{value:.{digits}f}" for value in row) for row in zip(*columns, strict=True)]
        if decimal != ".":
            lines = [line.replace(".", decimal) for line in lines]
        path.write_text("\n".join([header, *lines]) + "\n", encoding=encoding)

    return write


def _workbook(make: Callable[[], Rows]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import openpyxl

        rows, book = make(), openpyxl.Workbook()
        sheet = book.active
        sheet.append(["time [s]", "heater [%]", "temperature [degC]"])
        for row in zip(rows.t, rows.u, rows.y, strict=True):
            sheet.append([float(value) for value in row])
        book.save(path)

    return write


def _parquet(make: Callable[[], Rows]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import pyarrow
        from pyarrow import parquet

        rows = make()
        stamps = np.datetime64("2026-03-01T08:00:00", "ms") + (1000.0 * rows.t).astype("timedelta64[ms]")
        parquet.write_table(pyarrow.table({"timestamp": stamps, "valve": rows.u, "temperature": rows.y}), path)

    return write


DOORS: tuple[Door, ...] = (
    Door(name="oven_step.csv", plant=OVEN, write=_text(_oven_step, "time,heater,temperature")),
    Door(name="doublet.csv", plant=OVEN, write=_text(_doublet, "time,heater,temperature")),
    Door(name="staircase.csv", plant=EXCHANGER, write=_text(_staircase, "time,valve,temperature")),
    Door(name="closed_loop.csv", plant=EXCHANGER, write=_text(_loop, "t,r,u,y", order="truy")),
    Door(name="historian.csv", plant=BOILER_FEED, write=_text(_historian, "time,FIC7.OP,FIC7.PV")),
    Door(name="pid_block.csv", plant=EXCHANGER, write=_text(_pid_block, "Time,Input,Output,Setpoint", order="tyur")),
    Door(name="inverse.csv", plant=BOILER, write=_text(_inverse, "t,u,y")),
    Door(name="servo.csv", plant=SERVO, write=_text(_servo, "t,u,y")),
    Door(name="tank.csv", plant=TANK, write=_text(_tank, "time [s],inflow valve [%],level [%]")),
    Door(
        name="german.csv",
        plant=EXCHANGER,
        write=_text(_staircase, "Zeit;Stellgröße;Istwert", delimiter=";", decimal=",", encoding="cp1252"),
    ),
    Door(
        name="utf16.csv",
        plant=PRESSURE,
        write=_text(
            _milliamps, "t_ms;PT101_mA;YV101_pct", delimiter=";", order="tyu", encoding="utf-16", time_scale=1e3
        ),
    ),
    Door(name="workbook.xlsx", plant=OVEN, write=_workbook(_doublet)),
    Door(name="milliseconds.parquet", plant=EXCHANGER, write=_parquet(_staircase)),
    Door(name="long.csv", plant=EXCHANGER, write=_text(_long, "t,u,y", digits=3)),
)
