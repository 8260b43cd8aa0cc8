"""What is found where nothing is to be found: noise, swapped columns, a constant command, a loop driven by noise.

A loop whose command is at its limit for a while is none of a linear controller, and its plant can be told from routine
operation (Ljung 1999, section 13.4): there a plant is a false finding where it is not the true one.

``SURROGATES=N,COMMAND+COMMAND`` in the environment sets inputs per family and the commands; 200 and all when absent.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from autotune.arrays import FloatArray
from autotune.design.margins import margins
from autotune.errors import AutotuneError
from autotune.models import Block, Model, Port, TransferFunction
from autotune.points import FrequencyPoint
from autotune.recording import Recording

COUNT = 200
#: Rows of an input: short, usual and long records take turns.
_ROWS = (300, 800, 2000)
#: A finding counts from this probability on, where a command states one.
_PROBABLE = 0.5
#: Chi-square of a point's two values, beyond which the truth is by chance once in a thousand.
_SURE = 13.8

#: What a diagnosis takes the plant for.
NOMINAL = Model(
    name="nominal", input=Port(unit="", offset=5.0), output=Port(unit="", offset=50.0),
    blocks=(Block(name="plant", place="plant", dynamics=TransferFunction(num=(2.0,), den=(9.5, 1.0), delay_s=3.0)),),
)  # fmt: skip


def _commands(rng: np.random.Generator, rows: int) -> FloatArray:
    return np.repeat(rng.choice([4.5, 5.5], rows // 20 + 1), 20)[:rows]


def _driven(rng: np.random.Generator, u: FloatArray, gain: float = 2.0) -> FloatArray:
    late = np.concatenate([np.full(3, u[0]), u[:-3]]) - 5.0
    return 50.0 + gain * lfilter([0.1], [1.0, -0.9], late) + 0.05 * rng.standard_normal(u.size)


def _white(rng: np.random.Generator, rows: int) -> tuple[FloatArray, FloatArray]:
    return rng.standard_normal(rows), rng.standard_normal(rows)


def _stepping(rng: np.random.Generator, rows: int) -> tuple[FloatArray, FloatArray]:
    return _commands(rng, rows), rng.standard_normal(rows)


def _autoregressive(rng: np.random.Generator, rows: int) -> tuple[FloatArray, FloatArray]:
    return lfilter([1.0], [1.0, -0.9], rng.standard_normal(rows)), lfilter(
        [1.0], [1.0, -0.95], rng.standard_normal(rows)
    )


def _walk(rng: np.random.Generator, rows: int) -> tuple[FloatArray, FloatArray]:
    return np.cumsum(rng.standard_normal(rows)), np.cumsum(rng.standard_normal(rows))


def _swapped(rng: np.random.Generator, rows: int) -> tuple[FloatArray, FloatArray]:
    u = _commands(rng, rows)
    return _driven(rng, u), u


def _sines(rng: np.random.Generator, rows: int) -> FloatArray:
    """Return two sines of 5 to 40 periods in the record."""
    turns = 2.0 * np.pi * np.outer(np.arange(rows) / rows, rng.uniform(5.0, 40.0, 2))
    return 5.0 + np.sum(0.5 * np.sin(turns + rng.uniform(0.0, 6.3, 2)), axis=1)


def _under_sines(rng: np.random.Generator, rows: int) -> tuple[FloatArray, FloatArray]:
    return _sines(rng, rows), lfilter([1.0], [1.0, -0.95], rng.standard_normal(rows))


def _swapped_sines(rng: np.random.Generator, rows: int) -> tuple[FloatArray, FloatArray]:
    u = _sines(rng, rows)
    return _driven(rng, u), u


def _wrong_sign(rng: np.random.Generator, rows: int) -> tuple[FloatArray, FloatArray]:
    u = _commands(rng, rows)
    return u, _driven(rng, u, -2.0)


def _constant(rng: np.random.Generator, rows: int) -> tuple[FloatArray, FloatArray]:
    return np.full(rows, 5.0), 50.0 + np.cumsum(rng.standard_normal(rows))


class _Drawn(NamedTuple):
    """A loop: gain and integral time of its PI, rows of delay, colour of the noise, time constant; times in rows."""

    gain: float
    reset: float
    delay: int
    colour: float
    lag: float

    @property
    def plant(self) -> TransferFunction:
        """The plant, its command held from row to row."""
        return TransferFunction(num=(1.0,), den=(self.lag, 1.0), delay_s=self.delay - 1.0)


def _drawn(rng: np.random.Generator) -> _Drawn:
    gain, reset, delay = rng.uniform(0.2, 2.0), rng.uniform(5.0, 50.0), int(rng.integers(1, 8))
    return _Drawn(gain, reset, delay, rng.uniform(0.0, 0.98), rng.uniform(5.0, 50.0))


def _loop(rng: np.random.Generator, rows: int, limit: float = np.inf) -> tuple[FloatArray, FloatArray]:
    """Return u and y of a PI loop that only its own coloured noise drives, the command limited or not."""
    gain, reset, delay, colour, time = _drawn(rng)
    lag = float(np.exp(-1.0 / time))
    u, y = np.zeros(rows + 200), np.zeros(rows + 200)
    x = noise = total = 0.0
    for k in range(y.size):
        x = lag * x + (1.0 - lag) * (u[k - delay] if k >= delay else 0.0)
        noise = colour * noise + 0.1 * rng.standard_normal()
        y[k] = x + noise
        total += -gain / reset * y[k]
        wanted = -gain * y[k] + total
        u[k] = np.clip(wanted, -limit, limit)
        total += u[k] - wanted
    return u[200:], y[200:]


def _limited(rng: np.random.Generator, rows: int) -> tuple[FloatArray, FloatArray]:
    return _loop(rng, rows, 0.3)


FAMILIES: dict[str, Callable[[np.random.Generator, int], tuple[FloatArray, FloatArray]]] = {
    "white": _white, "white under steps": _stepping, "autoregressive": _autoregressive, "random walk": _walk,
    "swapped": _swapped, "wrong sign": _wrong_sign, "constant u": _constant, "linear loop": _loop,
    "linear loop, limited": _limited, "noise under two sines": _under_sines, "swapped, two sines": _swapped_sines,
}  # fmt: skip


def true_plant(family: str, seed: int) -> TransferFunction | None:
    """Return the plant that an input can tell of, None where it can tell of none."""
    return _drawn(np.random.default_rng(seed)).plant if family == "linear loop, limited" else None


def surrogate(family: str, seed: int) -> Recording:
    """Return one input of a family."""
    rows = _ROWS[seed % len(_ROWS)]
    u, y = FAMILIES[family](np.random.default_rng(seed), rows)
    return Recording(t=np.arange(rows, dtype=np.float64), u=u, y=y, name=f"{family} {seed}")


def _tune(recording: Recording, true: TransferFunction | None) -> bool:
    from autotune.config.procedure import DesignSettings
    from autotune.pipeline import analyse, measure_plant

    found, asked = measure_plant([recording]), DesignSettings(criterion="iae")
    design = analyse(found.points, asked, fit=found.fit, facts=found.facts, compare=False).design
    if true is None:
        return True
    kept, (modulus, phase_rad) = margins(true, design.controller), asked.margins
    return not kept.stable or kept.modulus < modulus or kept.phase_rad < phase_rad


def _delay(recording: Recording, true: TransferFunction | None) -> bool:
    from autotune.api.methods import delay

    delay(recording, 2)
    return True


def _frequency(recording: Recording, true: TransferFunction | None) -> bool:
    from autotune.identification.frequency.recorded import frequency_points

    points = frequency_points(recording).points
    return true is None or max((_apart(point, true) for point in points), default=0.0) > _SURE


def _closed_loop(recording: Recording, true: TransferFunction | None) -> bool:
    from autotune.api.methods import closed_loop

    points = closed_loop(recording).points
    return true is None or max((_apart(point, true) for point in points), default=0.0) > _SURE


def _apart(point: FrequencyPoint, true: TransferFunction) -> float:
    """Return how far a plant's response is from a point, in units of its covariance: chi-square of two values."""
    away = complex(true.response(np.array([point.omega_rad_s]))[0]) - point.response
    both = np.array([away.real, away.imag])
    return float(both @ np.linalg.solve(np.array(point.covariance), both))


def _watch(recording: Recording, true: TransferFunction | None) -> bool:
    from autotune.identification.delay.tracking import track

    length = recording.duration_s
    windows = track(recording, 2, window_s=0.4 * length, every_s=0.3 * length, max_delay_s=0.1 * length)
    return any(window.model is not None for window in windows)


def _routine(recording: Recording, true: TransferFunction | None) -> bool:
    from autotune.diagnosis.routine import diagnose_routine

    return diagnose_routine([recording]).verdict in ("stiction", "backlash")


def _diagnose(recording: Recording, true: TransferFunction | None) -> bool:
    from autotune.diagnosis.diagnose import diagnose

    found = diagnose(NOMINAL, [recording])
    of_columns = found.sentences[0].startswith("First of all") and not recording.name.startswith(_MISREAD)
    return of_columns or any(effect.probability >= _PROBABLE for effect in found.effects)


COMMANDS: dict[str, Callable[[Recording, TransferFunction | None], bool]] = {
    "tune": _tune, "identify frequency": _frequency, "identify delay": _delay, "identify closed-loop": _closed_loop,
    "watch": _watch, "diagnose --routine": _routine, "diagnose": _diagnose,
}  # fmt: skip
#: Families whose columns are not what they are taken for, which is to be said.
_MISREAD = ("swapped", "swapped, two sines", "wrong sign")
#: A wrong sign is one beside a model only.
_RIGHT = {("wrong sign", name) for name in COMMANDS if name != "diagnose"}


def is_false(command: str, family: str, seed: int) -> bool:
    """Return whether a command finds something false in an input; a refusal finds nothing."""
    try:
        return COMMANDS[command](surrogate(family, seed), true_plant(family, seed))
    except AutotuneError:
        return False


def main() -> None:
    """Print how many findings each command makes in each family, and the worst share."""
    count, _, names = os.environ.get("SURROGATES", str(COUNT)).partition(",")
    commands = names.split("+") if names else list(COMMANDS)
    print(f"| false findings of {count} | {' | '.join(commands)} |\n|{'---|' * (len(commands) + 1)}")
    for family in FAMILIES:
        cells = []
        for command in commands:
            if (family, command) in _RIGHT:
                cells.append("")
                continue
            found = [seed for seed in range(int(count)) if is_false(command, family, seed)]
            cells.append(str(len(found)))
            if found:
                print(f"{command} on {family}: seeds {found}", file=sys.stderr, flush=True)
        print(f"| {family} | {' | '.join(cells)} |", flush=True)
