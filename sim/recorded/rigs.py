"""Folders of rigs that exist: a model and recordings, read without the tool's own readers.

::

    DIR/NAME/model.toml     nominal chain
    DIR/NAME/*.csv          recordings, columns t,u,y and further ones; those named test* or unseen* are kept back
    DIR/NAME/*.toml         beside a recording: its sidecar
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim.conceal.physics import Floats
from sim.recorded.chain import Block, Chain, horizon_rows

#: Beginnings of the names of recordings that are kept back.
KEPT_BACK = ("test", "unseen")
#: Steps may differ by this share of their median, in this share of the rows.
EVEN, MOSTLY = 0.1, 0.01
LEAST_ROWS = 100


class RefusedError(Exception):
    """A rig, or an effect on it, that cannot be used, and why."""


@dataclass(frozen=True, kw_only=True)
class Record:
    """Rows of one recording; ``others`` are its further columns, ``name`` the file's stem."""

    name: str
    t: Floats
    u: Floats
    y: Floats
    others: Mapping[str, Floats] = field(default_factory=dict)

    def rows(self, keep: slice) -> Record:
        """Return some rows."""
        others = {name: values[keep] for name, values in self.others.items()}
        return replace(self, t=self.t[keep], u=self.u[keep], y=self.y[keep], others=others)


@dataclass(frozen=True, kw_only=True)
class Rig:
    """One rig: nominal chain, recordings that the tool is given, recordings that are kept back.

    ``Ts`` [s] is the sample time, ``horizon`` the rows of a forecast, ``held`` whether u is held between rows.
    """

    name: str
    folder: Path
    chain: Chain
    given: tuple[Record, ...]
    kept_back: tuple[Record, ...]
    Ts: float
    horizon: int
    closed_loop: bool
    held: bool
    unit_u: str
    unit_y: str

    @property
    def every(self) -> tuple[Record, ...]:
        """All recordings."""
        return self.given + self.kept_back

    @property
    def moves(self) -> bool:
        """Whether the command moves in what the tool is given."""
        return any(np.ptp(r.u) > 0.0 for r in self.given)

    @property
    def stamp(self) -> str:
        """SHA-256 of model and recordings, as hexadecimal digits."""
        digest = hashlib.sha256((self.folder / "model.toml").read_bytes())
        for r in self.every:
            digest.update((self.folder / f"{r.name}.csv").read_bytes())
        return digest.hexdigest()


def find(folder: Path) -> tuple[list[Rig], dict[str, str]]:
    """Read every rig in a folder.

    Parameters
    ----------
    folder : Path
        Holds rigs, or is one.

    Returns
    -------
    rigs, refused
        Those that can be used, by name, and why each other one cannot.
    """
    rigs, refused = [], {}
    for model in sorted(folder.rglob("model.toml")):
        name = model.parent.relative_to(folder).as_posix() if model.parent != folder else folder.resolve().name
        try:
            rigs.append(read(model.parent, name))
        except RefusedError as reason:
            refused[name] = str(reason)
    return rigs, refused


def read(folder: Path, name: str) -> Rig:
    """Read one rig.

    Parameters
    ----------
    folder : Path
        With its model and recordings.
    name : str
        Of the rig.

    Raises
    ------
    RefusedError
        No chain of blocks, no recording, rows that are not even or not numbers, a file that cannot be read.
    """
    try:
        stated = tomllib.loads((folder / "model.toml").read_text(encoding="utf-8"))
        chain = _chain(stated)
    except (ValueError, KeyError, TypeError) as error:
        raise RefusedError(f"model.toml cannot be read: {error}") from None
    if len(list(folder.glob("model*.toml"))) > 1:
        raise RefusedError("several models: give each a folder with its recordings")
    records = [_record(path) for path in sorted(folder.glob("*.csv"))]
    kept_back = tuple(r for r in records if r.name.lower().startswith(KEPT_BACK))
    given = tuple(r for r in records if r not in kept_back)
    if not given:
        raise RefusedError("no recording that is not kept back")
    Ts = float(np.median(np.diff(given[0].t)))
    for r in records:
        _require_even(r, Ts)  # refuses a time that stands still, too
    shortest = min(len(r.t) for r in given)
    return Rig(
        name=name,
        folder=folder,
        chain=chain,
        given=given,
        kept_back=kept_back,
        Ts=Ts,
        horizon=horizon_rows(chain, Ts, shortest, min((len(r.t) for r in kept_back), default=shortest)),
        closed_loop=any("r" in r.others for r in records) or any(_states_law(folder, r.name) for r in records),
        held=stated["input"].get("hold", "zero") == "zero",
        unit_u=str(stated["input"].get("unit", "-")),
        unit_y=str(stated["output"].get("unit", "-")),
    )


def _chain(stated: dict[str, Any]) -> Chain:
    if not isinstance(stated.get("input"), dict) or "block" not in stated:
        raise RefusedError("model.toml is no chain of blocks with one command")
    if stated.get("effect"):
        raise RefusedError("model.toml has effects of its own already")
    blocks = tuple(
        Block(
            num=tuple(float(c) for c in b["num"]),
            den=tuple(float(c) for c in b["den"]),
            delay=float(b.get("delay", 0.0)),
        )
        for b in stated["block"]
    )
    if any(len(np.trim_zeros(b.num, "f")) > len(np.trim_zeros(b.den, "f")) for b in blocks):
        raise RefusedError("a block has more zeros than poles")
    return Chain(
        blocks=blocks,
        u_offset=float(stated["input"].get("offset", 0.0)),
        y_offset=float(stated.get("output", {}).get("offset", 0.0)),
    )


def _record(path: Path) -> Record:
    lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line and not line.startswith("#")]
    header = [cell.strip() for cell in lines[0].split(",")] if lines else []
    if not {"t", "u", "y"} <= set(header):
        raise RefusedError(f"{path.name}: the header lacks t, u or y; autotune import writes files of that form")
    try:
        values = np.loadtxt(lines[1:], delimiter=",", ndmin=2)
    except ValueError as error:
        raise RefusedError(f"{path.name}: {error}") from None
    if values.shape[1] != len(header) or len(values) < LEAST_ROWS:
        raise RefusedError(f"{path.name}: fewer than {LEAST_ROWS} rows of {len(header)} numbers")
    columns = {name: np.ascontiguousarray(values[:, i]) for i, name in enumerate(header)}
    t, u, y = (columns.pop(name) for name in ("t", "u", "y"))
    if not np.all(np.isfinite([t, u, y])):
        raise RefusedError(f"{path.name}: a cell of t, u or y is not a number")
    return Record(name=path.stem, t=t, u=u, y=y, others=columns)


def _require_even(record: Record, Ts: float) -> None:
    off = ~(np.abs(np.diff(record.t) - Ts) < EVEN * Ts)
    if np.mean(off) > MOSTLY:
        raise RefusedError(f"{record.name}: {100 * np.mean(off):.0f} % of the rows are not {Ts:g} s apart")


def _states_law(folder: Path, name: str) -> bool:
    sidecar = folder / f"{name}.toml"
    if not sidecar.is_file():
        return False
    try:
        law = tomllib.loads(sidecar.read_text(encoding="utf-8")).get("controller", {})
    except ValueError as error:
        raise RefusedError(f"{sidecar.name} cannot be read: {error}") from None
    return str(law.get("kind", "open loop")) != "open loop"
