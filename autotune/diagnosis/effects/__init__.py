"""The catalogue: every effect that may be missing in a model, one file per place.

To add one, write its record into the tuple of its place (``docs/extending.md`` does so). Nothing else knows an effect
by its name: what a search, the simulation or the verdict needs to know of it stands in its record.
"""

from __future__ import annotations

from autotune.diagnosis.effects.actuator import ACTUATOR
from autotune.diagnosis.effects.base import EffectKind
from autotune.diagnosis.effects.checks import require_complete
from autotune.diagnosis.effects.controller import CONTROLLER
from autotune.diagnosis.effects.environment import ENVIRONMENT
from autotune.diagnosis.effects.plant import PLANT
from autotune.diagnosis.effects.sensor import SENSOR
from autotune.diagnosis.effects.timing import TIMING
from autotune.errors import InputError

#: All effects, places in the order in which a sample passes them.
ALL: tuple[EffectKind, ...] = (*ACTUATOR, *PLANT, *SENSOR, *TIMING, *ENVIRONMENT, *CONTROLLER)
require_complete(ALL)
#: All effects by their names.
KINDS: dict[str, EffectKind] = {kind.name: kind for kind in ALL}
#: Effects that are fitted as hypotheses.
CATALOGUE: dict[str, EffectKind] = {kind.name: kind for kind in ALL if kind.sought == "hypothesis"}
#: Structures that are fitted beside them and are no effects: what one of them explains better is not an effect's.
STRUCTURES: dict[str, EffectKind] = {kind.name: kind for kind in ALL if kind.sought == "structure"}


def kind_of(name: str, where: str = "catalogue") -> EffectKind:
    """Return an effect by its name.

    Raises
    ------
    InputError
        No effect of that name.
    """
    if name not in KINDS:
        raise InputError(f"effect {name!r} cannot be simulated", where=where, remedy="use a name of the catalogue")
    return KINDS[name]
