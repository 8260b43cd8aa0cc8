"""What ``autotune init`` is told of a rig's dynamics: a model file, or a transfer function as people write it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autotune.errors import InputError
from autotune.outputs import Output

if TYPE_CHECKING:
    from autotune.models import TransferFunction

EXAMPLE = "-65.5/(s(0.36s+1)) e^-0.1s"


@dataclass(frozen=True, kw_only=True)
class ModelOfRig:
    """A model of the rig.

    Attributes
    ----------
    text : str
        What was given: the file's name, or the transfer function.
    dynamics : TransferFunction or None
        From the command to the measurement, both as departures from the operating point; None where a file is named.
    """

    text: str
    dynamics: TransferFunction | None

    def place(self, config: Path) -> Output | None:
        """Return where the model file of a transfer function is written: beside the configuration, never over another.

        Raises
        ------
        InputError
            It is there already.
        """
        return None if self.dynamics is None else Output(config.with_name(f"{config.stem}_model.toml"))

    def path(self, config: Path) -> str:
        """Return the model file that the configuration names."""
        place = self.place(config)
        return self.text if place is None else str(place.path)

    def write(self, config: Path, answers: Mapping[str, Any]) -> Path | None:
        """Write the model file of a transfer function, which holds around the operating point, and return its path.

        Parameters
        ----------
        config : Path
            The configuration's file, beside which the model's lies.
        answers : mapping
            What the questions gave.
        """
        from autotune.model_tables import write_model
        from autotune.models import Block, Model, Port

        place = self.place(config)
        if place is None or self.dynamics is None:
            return None
        block = Block(name=config.stem, place="plant", dynamics=self.dynamics)
        model = Model(
            name=f"{config.stem}: {self.text}",
            input=Port(unit=answers["u_unit"], offset=answers["u"]),
            output=Port(unit=answers["y_unit"], offset=answers["y"]),
            blocks=(block,),
        )
        place.by(lambda part: write_model(model, part))
        return place.path


def model_of_rig(answer: str) -> ModelOfRig:
    """Return the model that an answer names or writes.

    Raises
    ------
    InputError
        It is neither a file nor a transfer function that can be read.
    """
    if os.path.isfile(answer):
        return ModelOfRig(text=answer, dynamics=None)
    if answer.endswith((".toml", ".fmu")):
        raise InputError("no such file", where=answer, remedy="give its path from this folder")
    from autotune.equations.transfer_text import parse_transfer_function

    return ModelOfRig(text=answer.strip(), dynamics=parse_transfer_function(answer))
