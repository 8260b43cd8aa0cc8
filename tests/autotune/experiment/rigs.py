"""Ball rigs and configurations that the experiment's tests share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from autotune.config import Config, load_config
from autotune.equations.chain import from_chain
from autotune.equations.transfer_text import parse_transfer_function
from autotune.experiment.loop import ControlLoop
from autotune.experiment.run import envelope_of
from autotune.models import Block, Model, Port
from autotune.recording import RecordingWriter
from drivers.model_plant import ModelPlant
from drivers.simulated import SimulatedRig
from sim.ball import make_ball
from tests.sim.imperfections import Fault, FaultyPlant, FaultyRig

CONFIG = Path(__file__).resolve().parents[3] / "configs" / "ball_sim.toml"
#: command that holds textbook plants at 0 [V]
U_REST = 5.0


#: a limit cycle for each point: faults that come at a certain time of such a sweep
EACH: dict[str, Any] = {"experiment": {"together": False}}


def ball_config(**sections: dict[str, Any]) -> Config:
    """Return the ball's configuration, as it is shipped, with some keys of some sections replaced."""
    config = load_config(CONFIG)
    return config.model_copy(
        update={name: getattr(config, name).model_copy(update=keys) for name, keys in sections.items()}
    )


def textbook_plant(written: str, *, u_start: float, noise: float) -> ModelPlant:
    """Return a plant from its transfer function, at rest under a command until now."""
    chain = Model(
        name="plant",
        input=Port(unit="V", offset=U_REST),
        output=Port(unit="cm", offset=0.0),
        blocks=(Block(name="plant", place="plant", dynamics=parse_transfer_function(written)),),
    )
    return ModelPlant(from_chain(chain), u_start=u_start, noise=noise)


def ball_rig(*, seed: int = 1, noise: float = 0.35, faults: Sequence[Fault] = ()) -> SimulatedRig:
    """Return a ball on the floor, behind faults."""
    return FaultyRig(FaultyPlant(make_ball(seed=seed, noise=noise), faults), u_safe=0.0)


def open_loop(rig: SimulatedRig, recording: Path, config: Config | None = None) -> ControlLoop:
    """Return a control loop on the rig that writes the recording, not yet entered."""
    writer = RecordingWriter(recording, ("t", "u", "y"))
    return ControlLoop(rig=rig, envelope=envelope_of(config or ball_config()), writer=writer)
