"""Many inputs through a chain at once are, column by column, what the simulation makes of each."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.diagnosis.simulation.assembly import assemble
from autotune.diagnosis.simulation.many_inputs import first_command, responses
from autotune.diagnosis.simulation.simulator import Windows
from autotune.models import Block, Model, Port, TransferFunction
from autotune.recording import Recording

ROWS, SAMPLE_S = 90, 0.1
#: A lag before a mode that rings; a lag with a direct path; an integrator behind a speed.
CHAINS = {
    "ringing": (((2.0,), (0.3, 1.0)), ((1.0,), (0.2, 0.05, 1.0))),
    "direct": (((0.5, 1.0), (1.0, 1.0)),),
    "integrating": (((1.0,), (0.4, 1.0)), ((1.0,), (1.0, 0.0))),
}


@pytest.mark.parametrize("name", CHAINS)
@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    delay_s=st.sampled_from((0.0, 0.1, 0.03, 0.27)),
    uneven=st.sampled_from((0.0, 0.03)),
    window=st.tuples(st.integers(0, 40), st.integers(41, ROWS)),
)
def test_every_column_is_a_simulation_of_its_own(
    name: str, seed: int, delay_s: float, uneven: float, window: tuple[int, int]
) -> None:
    rng = np.random.default_rng(seed)
    blocks = [
        Block(name=f"b{i}", place="plant", dynamics=TransferFunction(num=num, den=den, delay_s=delay_s * (i == 0)))
        for i, (num, den) in enumerate(CHAINS[name])
    ]
    sim = assemble(Model(name=name, blocks=tuple(blocks), input=Port(unit="V"), output=Port(unit="V")))
    t = SAMPLE_S * np.arange(ROWS) + uneven * rng.uniform(-1.0, 1.0, ROWS)
    inputs, (first, last) = rng.standard_normal((ROWS, 3)), window
    begin = first_command(sim.chain, t, first)
    found = responses(sim.chain, t, inputs[begin:last], (begin, first, last), SAMPLE_S)
    alone = Windows(starts=np.array([first]), stops=np.array([last]))
    for column, wanted in zip(found.T, inputs.T, strict=True):
        driven = Recording(t=t, u=wanted, y=0.0 * t)
        run, _ = sim.run(driven, np.zeros(sim.order), alone, sample_time_s=SAMPLE_S, signals=1)
        np.testing.assert_allclose(column, run[first:last, 0], rtol=1e-9, atol=1e-11)
