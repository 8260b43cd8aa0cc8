"""A reduced model as a model file, with what it was reduced from: what a controller's margins are then checked on."""

from __future__ import annotations

import os
from typing import Any

import tomli_w

from autotune.errors import InputError
from autotune.identification.reduction import ReducedModel
from autotune.model_tables import model_content, model_of
from autotune.models import Block, Model, Port, TransferFunction
from autotune.points import points_from_json, points_to_json
from autotune.text_files import read_toml
from autotune.whole_files import write_whole

_CHANGED = "its block is no longer the reduced model that [reduced] tells of"
#: relative change of a coefficient that is rounding of the text
_ROUNDING = 1e-9


def write_reduced(reduced: ReducedModel, path: str | os.PathLike[str]) -> None:
    """Write a model file whose table ``[reduced]`` holds the plant, and the points, that the model was reduced from.

    Parameters
    ----------
    reduced : ReducedModel
        As one block with a zero in the right half plane.
    path : path
        Where to.
    """
    block = Block(name="reduced model", place="plant", dynamics=reduced.transfer_function())
    content = model_content(Model(name="reduced model", input=Port(), output=Port(), blocks=(block,)))
    table: dict[str, Any] = {
        "G_r": reduced.G_r,
        "omega_d_rad_s": reduced.omega_d_rad_s,
        "conditions": reduced.conditions,
        "evidence": reduced.evidence[:200],
    }
    if reduced.omega_0r_rad_s is not None:
        table["omega_0r_rad_s"] = reduced.omega_0r_rad_s
    if reduced.plant is not None:
        H = reduced.plant
        table["plant"] = {"num": list(H.num), "den": list(H.den), "delay": H.delay_s}
    if reduced.points:
        table["point"] = points_to_json(reduced.points)
    write_whole(path, tomli_w.dumps(content | {"reduced": table}))


def read_reduced(path: str | os.PathLike[str]) -> ReducedModel | None:
    """Return the reduced model of a file of :func:`write_reduced`; None for any other model file.

    Raises
    ------
    InputError
        A table ``[reduced]`` that is not complete, or that tells of another model than the file's block.
    """
    content, where = read_toml(path), f"{path} [reduced]"
    table = content.get("reduced")
    if table is None:
        return None
    try:
        lag = table.get("omega_0r_rad_s")
        found = ReducedModel(
            G_r=float(table["G_r"]),
            omega_0r_rad_s=None if lag is None else float(lag),
            omega_d_rad_s=float(table["omega_d_rad_s"]),
            conditions=table["conditions"],
            evidence=str(table.get("evidence", "")),
            plant=model_of({"block": [table["plant"]]}, where).transfer_function() if "plant" in table else None,
            points=points_from_json(table.get("point", []), where),
        )
        stated = found.transfer_function()
    except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            "needs G_r, omega_d_rad_s, conditions, and what it was reduced from",
            where=where,
            remedy="write it again with autotune reduce, or delete the table to design on the block alone",
        ) from None
    if not _same(stated, model_of(content, str(path)).transfer_function()):
        raise InputError(_CHANGED, where=where, remedy="reduce again, or delete the table to design on the block alone")
    return found


def _same(one: TransferFunction, other: TransferFunction) -> bool:
    """Return whether two reduced models are the same but for rounding of their text."""
    if (len(one.num), len(one.den), one.delay_s) != (len(other.num), len(other.den), other.delay_s):
        return False
    pairs = zip((*one.num, *one.den), (*other.num, *other.den), strict=True)
    return all(abs(a - b) <= _ROUNDING * max(abs(a), abs(b)) for a, b in pairs)
