"""Units of recordings beside those of a model, and beside each other: compared before a number is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Protocol

from autotune.errors import InputError
from autotune.recording import Recording
from autotune.units import read_unit


class HasUnits(Protocol):
    """A model of whatever form that says in which units its signals are."""

    @property
    def name(self) -> str:
        """What it is called."""

    @property
    def signal_units(self) -> Mapping[str, str]:
        """Unit of each column of a recording."""


def require_units_of_model(model: HasUnits, recordings: Sequence[Recording]) -> None:
    """Refuse a model beside recordings whose columns are in other units than its signals.

    Parameters
    ----------
    model : HasUnits
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
    for recording in recordings:
        _require(recording, model.signal_units, f"the model {model.name!r}")


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
        found, wanted = read_unit(own), read_unit(other)
        if found is None or wanted is None:
            continue
        if found.powers != wanted.powers:
            how = "which do not convert"
        elif found.is_as_large_as(wanted):
            continue
        else:
            how = f"a factor of {found.factor / wanted.factor:.6g}"
        raise InputError(
            f"{column} is in {own}, and in {other} in {beside}: {how}",
            where=recording.name,
            remedy="convert the column, or correct the unit where it is wrong",
        )
