"""The simulation written from the effects' records: a line that is added or changed is compiled, never an old one."""

from __future__ import annotations

import inspect
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.diagnosis.simulation import stages
from autotune.diagnosis.simulation.assembly import assemble
from autotune.diagnosis.simulation.compiled import layout_of, run_of, source_of
from autotune.effects import ALL
from autotune.effects.base import EffectKind, Quantity
from autotune.effects.checks import require_complete
from autotune.effects.stages import STAGES, Line
from autotune.errors import InputError
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording


def softened(w: float, limit: float) -> float:
    return limit * math.tanh(w / limit)


def hardened(w: float, limit: float) -> float:
    return limit * math.sinh(w / limit)


def rooted(w: float, limit: float) -> float:
    return float(np.cbrt(w)) * limit


SOFT = EffectKind(
    name="actuator.soft_saturation",
    equation="w = limit tanh(w / limit)",
    parameters=(Quantity(name="limit", unit="{u}", role="threshold"),),
    reference="none",
    lines=(Line(stage="command", does=softened),),
    starts=lambda sizes: [(1.0,)],
)


def heater() -> Model:
    block = Block(name="heater", place="plant", dynamics=TransferFunction(num=(1.0,), den=(2.0, 1.0)))
    return Model(name="heater", input=Port(), output=Port(), blocks=(block,))


def simulated(kind: EffectKind, limit: float, u: np.ndarray) -> np.ndarray:
    """Readings of 1/(2 s + 1) behind an effect, by the simulation written with it."""
    kinds = (*ALL, kind)
    require_complete(kinds)
    layout, run = layout_of(kinds), run_of(kinds)
    sim = assemble(heater())
    acts, values = np.zeros(len(layout.kinds), dtype=np.int64), np.zeros(len(layout.slots))
    acts[layout.flag(kind.name)] = 1
    values[layout.slots[kind.name, "limit"]] = limit
    sim = replace(sim, kinds=(kind,), acts=acts, values=values, compiled=run)
    out, _ = sim.run(Recording(t=0.1 * np.arange(u.size), u=u, y=0.0 * u), np.zeros(1), signals=1)
    return np.asarray(out[:, 0])


def exact(w: np.ndarray) -> np.ndarray:
    y = np.zeros(w.size)
    for k in range(w.size - 1):
        y[k + 1] = w[k] + (y[k] - w[k]) * np.exp(-0.1 / 2.0)
    return y


def test_a_new_line_is_simulated_and_a_changed_one_is_another_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    u = np.random.default_rng(1).normal(size=200)
    np.testing.assert_allclose(simulated(SOFT, 0.8, u), exact(0.8 * np.tanh(u / 0.8)), atol=1e-9)
    hard = replace(SOFT, lines=(Line(stage="command", does=hardened),))
    before = {path.name for path in (tmp_path / "autotune").glob("simulation_*.py")}
    run_of((*ALL, hard))
    after = {path.name for path in (tmp_path / "autotune").glob("simulation_*.py")}
    assert len(after - before) == 1  # the compiler keeps what it made by the file's name


def test_the_stages_without_effects_take_what_their_table_says() -> None:
    for name, stage in STAGES.items():
        taken = tuple(inspect.signature(getattr(stages, name).py_func).parameters)
        assert taken == (*stage.value, *stage.signals, "effects"), name


def test_a_line_that_uses_more_than_math_and_its_own_file_is_refused() -> None:
    with pytest.raises(InputError, match=r"soft_saturation: its line uses np; use math"):
        source_of((*ALL, replace(SOFT, lines=(Line(stage="command", does=rooted),))))


def test_every_effect_with_lines_is_in_the_written_source() -> None:
    source = source_of(ALL)
    for kind in ALL:
        for line in kind.lines:
            assert f"_{line.does.__name__}(" in source
