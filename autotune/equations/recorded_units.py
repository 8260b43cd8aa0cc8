"""Units of recordings beside those of a model, and beside each other: compared before a number is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

from autotune.equations.black_box import BlackBox
from autotune.equations.model import EquationModel
from autotune.equations.units import understood
from autotune.errors import InputError
from autotune.models import Model
from autotune.recording import Recording


def require_units_of_model(model: Model | EquationModel | BlackBox, recordings: Sequence[Recording]) -> None:
    """Refuse a model beside recordings whose columns are in other units than its signals.

    Parameters
    ----------
    model : Model, EquationModel or BlackBox
        A chain, equations or an FMU.
    recordings : sequence of Recording
        Their sidecars' ``[units]`` are compared, column by column.

    Raises
    ------
    InputError
        Two units of different dimension or size; names both.

    Notes
    -----
    A unit that is not given or not known contradicts nothing. Degrees Celsius and kelvin have one size, and count as
    one.
    """
    if isinstance(model, Model):
        units = {"u": model.input.unit, "y": model.output.unit}
    else:
        units = {one.column: one.unit for one in model.inputs} | {"y": model.output_unit}
    for recording in recordings:
        _require(recording, units, f"the model {model.name!r}")


def require_units_of_each_other(recordings: Sequence[Recording]) -> None:
    """Refuse recordings that are taken together and have a column in different units.

    Raises
    ------
    InputError
        Two units of different dimension or size; names both.
    """
    for before, recording in pairwise(recordings):
        _require(recording, _units(before), before.name)


def _units(recording: Recording) -> Mapping[str, str]:
    units = recording.metadata.get("units", {})
    return {str(name): one for name, one in units.items() if isinstance(one, str)} if isinstance(units, Mapping) else {}


def _require(recording: Recording, units: Mapping[str, str], beside: str) -> None:
    for column, own in _units(recording).items():
        other = units.get(column, "")
        if not own or not other or own == other:
            continue
        found, wanted = understood(own), understood(other)
        if found is None or wanted is None:
            continue
        if found.powers != wanted.powers:
            how = "which do not convert"
        elif math.isclose(found.factor, wanted.factor, rel_tol=1e-6):
            continue
        else:
            how = f"a factor of {found.factor / wanted.factor:.6g}"
        raise InputError(
            f"{column} is in {own}, and in {other} in {beside}: {how}",
            where=recording.name,
            remedy="convert the column, or correct the unit where it is wrong",
        )
