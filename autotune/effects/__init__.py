"""The catalogue: every effect that may be missing in a model, one file per place.

To add one, write its record into the tuple of its place (``docs/extending.md`` does so). Nothing else knows an effect
by its name: what a search, the simulation or the verdict needs to know of it stands in its record.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

from autotune.effects.actuator import ACTUATOR
from autotune.effects.base import EffectKind
from autotune.effects.checks import require_complete
from autotune.effects.controller import CONTROLLER
from autotune.effects.environment import ENVIRONMENT
from autotune.effects.plant import PLANT
from autotune.effects.sensor import SENSOR
from autotune.effects.timing import TIMING
from autotune.errors import InputError
from autotune.models import Effect

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

    Parameters
    ----------
    name : str
        PLACE.EFFECT, as in a model file.
    where : str
        Names the file in the refusal.

    Raises
    ------
    InputError
        No effect of that name.
    """
    if name not in KINDS:
        raise unknown(name, where)
    return KINDS[name]


def counted_as(name: str) -> frozenset[str]:
    """Return the effects whose finding is one of an effect: itself, those like it, and larger ones that include it."""
    larger = (kind.name for kind in KINDS.values() if name in kind.includes)
    return frozenset((name, *KINDS[name].same, *KINDS[name].like, *larger))


def shared_name(name: str) -> str:
    """Return the one name of all effects that command and reading cannot tell from one another."""
    return min((name, *KINDS[name].same, *KINDS[name].like))


def forms_of(names: Iterable[str]) -> frozenset[str]:
    """Return effects by one name for all forms of each: the one that it includes, or that none can tell from it."""
    return frozenset(shared_name(next(iter(KINDS[name].includes), name)) for name in names)


def related_effects(names: Iterable[str]) -> set[str]:
    """Return the effects that are not added beside others: these, what they include, and what includes them."""
    given = set(names)
    inner = {other for name in given for other in KINDS[name].includes}
    return given | inner | {kind.name for kind in KINDS.values() if given & set(kind.includes)}


def unknown(name: str, where: str) -> InputError:
    """Return the error of an effect that no catalogue has: the name that may be meant, and all that there are.

    Parameters
    ----------
    name : str
        What was written.
    where : str
        Names the file.
    """
    names = sorted(KINDS)
    near = get_close_matches(name, names, 1)
    meant = f"did you mean {near[0]!r}? " if near else ""
    return InputError(f"unknown effect {name!r}", where=where, remedy=f"{meant}Known are {', '.join(names)}")


def require_known(effects: Iterable[Effect], where: str, *, in_chain: bool = True) -> None:
    """Refuse effects that the catalogue does not have, or not for a chain of blocks.

    Parameters
    ----------
    effects : iterable of Effect
        Of a model.
    where : str
        Names the file in the refusal.
    in_chain : bool
        Whether they act in a chain of blocks.

    Raises
    ------
    InputError
        The first of them, with the list of known ones.
    """
    for effect in effects:
        if effect.name not in KINDS:
            raise unknown(effect.name, where)
        if in_chain and KINDS[effect.name].sought == "equations":
            raise InputError(f"{effect.name} acts in models of equations alone", where=where,
                             remedy="write the plant as equations, or take the effect out")  # fmt: skip
