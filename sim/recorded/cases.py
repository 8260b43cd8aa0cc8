"""Cases of recorded rigs: draw rig, effect and strength by the seed, search the size, write the case and its answer.

A case's seed says which rig it is of (round after round) and which effect is tried first; where a rig does not take it,
another one is drawn. Some cases change numbers only: a gain, an offset or a unit, for which nothing new may be named.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim.conceal.cases import STRENGTHS
from sim.conceal.physics import Floats
from sim.recorded import chain as linear
from sim.recorded.effects import EFFECTS, Effect, require_exact, require_no_converter
from sim.recorded.readings import Put, Scale
from sim.recorded.rigs import Record, RefusedError, Rig
from sim.whole import write_text

#: Cases of a round through all effects that change numbers only; steps through the effects from rig to rig.
NUMBERS, STRIDE = 3, 5
#: Sizes that are tried for a strength; largest size.
TRIES, LARGEST = 14, 400.0
#: Largest range of a changed command, in that of the recorded one.
MOST_SPAN = 1.5


@dataclass(frozen=True, kw_only=True)
class Ready:
    """A rig with the refit of its recordings as they are: numbers of the chain, rms of the residual, scale."""

    rig: Rig
    numbers: Floats
    noise: float
    scale: Scale

    @property
    def window(self) -> int:
        """Rows of a window."""
        return 2 * self.rig.horizon


def prepare(rig: Rig) -> Ready:
    """Refit the nominal chain to a rig's recordings as they are.

    Raises
    ------
    RefusedError
        The refit leaves nothing, or as much as there is: no strength can be measured.
    """
    numbers, noise = linear.retune(rig.chain, _pairs(rig.given), rig.Ts, 2 * rig.horizon)
    dy = float(np.mean([np.std(r.y) for r in rig.given]))
    if not 1e-9 * dy < noise < dy:
        raise RefusedError(f"the nominal chain, refitted, leaves {noise / max(dy, 1e-300):.2g} of y's spread")
    u, y = (np.concatenate([getattr(r, name) for r in rig.every]) for name in "uy")
    length = max(float(r.t[-1] - r.t[0]) for r in rig.every)
    scale = Scale(
        u0=rig.chain.u_offset,
        y0=rig.chain.y_offset,
        du=float(np.mean([np.std(r.u) for r in rig.given])),
        dy=dy,
        u_span=float(np.ptp(u)),
        y_low=float(np.min(y)),
        y_high=float(np.max(y)),
        noise=noise,
        tau=min(rig.chain.slowest_s or length, 0.125 * length),
        length=length,
        Ts=rig.Ts,
        unit_u=rig.unit_u,
        unit_y=rig.unit_y,
    )
    return Ready(rig=rig, numbers=numbers, noise=noise, scale=scale)


def _pairs(records: Sequence[Record]) -> list[tuple[Floats, Floats]]:
    return [(r.u, r.y) for r in records]


def change_recordings(ready: Ready, put: Put, seed: int) -> tuple[list[Record], list[Record]]:
    """Return the recordings that the tool is given and those kept back, with the effect in them.

    Parameters
    ----------
    ready : Ready
        The rig.
    put : Put
        The effect at one size.
    seed : int
        Of what is random in it.

    Raises
    ------
    RefusedError
        The command would go too far.
    """
    count = len(ready.rig.given)
    made = [put.apply(r, np.random.default_rng([seed, 10 + i])) for i, r in enumerate(ready.rig.every)]
    if max(float(np.ptp(r.u)) for r in made) > MOST_SPAN * ready.scale.u_span:
        raise RefusedError("the command would go far beyond all that the rig was given")
    return made[:count], made[count:]


def ratio(ready: Ready, put: Put, seed: int) -> tuple[float, Floats]:
    """Residual of the chain refitted to what is changed, over that of the recordings as they are; and its numbers.

    Parameters
    ----------
    ready : Ready
        The rig.
    put : Put
        The effect at one size.
    seed : int
        Of what is random in it.
    """
    rig = ready.rig
    given, _ = change_recordings(ready, put, seed)
    numbers, rms = linear.retune(rig.chain, _pairs(given), rig.Ts, ready.window, ready.numbers)
    return rms / ready.noise, numbers


def _search_size(ready: Ready, effect: Effect, strength: str, seed: int) -> Put:
    """Return the effect at a size at which the residual has grown as the strength says.

    Raises
    ------
    RefusedError
        No size does that, or none that can be put in.
    """
    low, high = STRENGTHS[strength]
    target = float(np.exp(np.random.default_rng([seed, 5]).uniform(np.log(low), np.log(high))))
    size, below, above, reason = 1.0, 1e-3, LARGEST, "no size has the strength"
    for _ in range(TRIES):
        try:
            put = effect.make(size, ready.scale, np.random.default_rng([seed, 6]))
            require_no_converter(ready.rig.every, [r for part in change_recordings(ready, put, seed) for r in part])
            found, _ = ratio(ready, put, seed)
        except RefusedError as why:
            found, reason = np.inf, str(why)
        if low <= found <= high:
            return put
        below, above = (size, above) if found < target else (below, size)
        if above / below < 1.0 + 1e-3:
            break
        guess = size * np.sqrt((target**2 - 1.0) / max(min(found, 10.0) ** 2 - 1.0, 1e-3))
        guess = float(np.clip(guess, size / 4.0, size * 4.0))
        size = guess if below < guess < above else float(np.sqrt(below * above))
    raise RefusedError(reason)


@dataclass(frozen=True, kw_only=True)
class Made:
    """A case: its rig, what was put in (nothing where only numbers changed), and the recordings."""

    ready: Ready
    effect: Effect | None
    strength: str | None
    put: Put
    ratio: float
    numbers: Floats
    given: list[Record]
    kept_back: list[Record]
    passed_over: list[str]


def make(seed: int, rigs: Sequence[Ready]) -> Made:
    """Make the case of a seed among the rigs of a campaign.

    Parameters
    ----------
    seed : int
        Of the case.
    rigs : sequence of Ready
        Those of the campaign.
    """
    ready, turn = rigs[seed % len(rigs)], seed // len(rigs)
    rng = np.random.default_rng([seed, 0])
    place = (STRIDE * (seed % len(rigs)) + turn) % (len(EFFECTS) + NUMBERS)
    passed_over: list[str] = []
    for effect in _in_turn(place, rng):
        try:
            require_exact(effect, ready.rig, ready.noise)
        except RefusedError as why:
            passed_over.append(f"{effect.name}: {why}")
            continue
        for strength in (str(one) for one in rng.permutation(list(STRENGTHS))):
            try:
                put = _search_size(ready, effect, strength, seed)
                return _make_case(ready, effect, strength, put, seed, passed_over)
            except RefusedError as why:
                passed_over.append(f"{effect.name}, {strength}: {why}")
    return _make_case(ready, None, None, _numbers_only(ready, place, rng), seed, passed_over)


def _in_turn(place: int, rng: np.random.Generator) -> list[Effect]:
    """Return the effect at a place, then the others as they are drawn; none at the places for numbers."""
    if place >= len(EFFECTS):
        return []
    others = [EFFECTS[i] for i in rng.permutation(len(EFFECTS)) if i != place]
    return [EFFECTS[place], *others]


def _make_case(
    ready: Ready, effect: Effect | None, strength: str | None, put: Put, seed: int, passed_over: list[str]
) -> Made:
    found, numbers = ratio(ready, put, seed)
    given, kept_back = change_recordings(ready, put, seed)
    return Made(
        ready=ready, effect=effect, strength=strength, put=put, ratio=found, numbers=numbers, given=given,
        kept_back=kept_back, passed_over=passed_over,
    )  # fmt: skip


def _numbers_only(ready: Ready, place: int, rng: np.random.Generator) -> Put:
    """Change a number of the model only: the command's gain or offset, or the unit of the reading."""
    s, factor = ready.scale, float(np.exp(rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 0.2)))
    which = ("gain", "offset", "unit")[place % NUMBERS] if ready.rig.moves else "unit"
    match which:
        case "gain":
            return Put(
                apply=lambda r, rng: replace(r, u=s.u0 + (r.u - s.u0) / factor), parameters={"gain": (factor, "-")}
            )
        case "offset":
            b = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.3)) * s.du
            return Put(apply=lambda r, rng: replace(r, u=r.u - b), parameters={"offset": (b, s.unit_u)})
        case _:
            return Put(
                apply=lambda r, rng: replace(r, y=s.y0 + (r.y - s.y0) * factor), parameters={"unit": (factor, "-")}
            )


def answer(made: Made, seed: int) -> dict[str, Any]:
    """Return the sealed answer of a case, in the form of :mod:`sim.conceal.cases`.

    Parameters
    ----------
    made : Made
        The case.
    seed : int
        Its seed.
    """
    rig, effect = made.ready.rig, made.effect
    errors = _unseen_errors(made)
    values = {name: {"value": value, "unit": unit} for name, (value, unit) in made.put.parameters.items()}
    named = {"name": effect.name, "accept": effect.accepted(rig), "parameters": values} if effect else None
    return {
        "kind": "single" if effect else "clean",
        "sub": None if effect else f"numbers: {', '.join(made.put.parameters)}",
        "rig": rig.name,
        "verdict": "effect" if effect else "parameters",
        "effects": [named] if named else [],
        "places": sorted({effect.name.split(".")[0], *effect.places}) if effect else [],
        "nuisance": [],
        "strength": made.strength,
        "improvable": bool(effect and effect.forecastable and errors and errors["retuned"] > 1.1 * errors["noise"]),
        "closed_loop": rig.closed_loop,
        "residual": made.ready.noise,
        "Ts": rig.Ts,
        "horizon": rig.horizon * rig.Ts,
        "nrmse_unseen": errors,
        "retuned_train_ratio": round(made.ratio, 4),
        "parameters": values,
        "passed_over": made.passed_over,
        "seed": seed,
    }


def _unseen_errors(made: Made) -> dict[str, float]:
    """Forecast errors on the recording kept back, of the refitted chain with the effect and without, over y's spread.

    The second one, key ``noise``, is what a model that knew the effect would be left with.
    """
    if not made.kept_back:
        return {}
    rig = made.ready.rig
    k = longest(made.kept_back)
    after, before = made.kept_back[k], rig.kept_back[k]
    spread = _spread(rig, after)

    def error(numbers: Floats, r: Record) -> float:
        e = linear.forecast_error(linear.moved(rig.chain, numbers), r.u, r.y, rig.Ts, rig.horizon)
        return float(np.sqrt(np.mean(e**2))) / spread

    return {"retuned": error(made.numbers, after), "noise": error(made.ready.numbers, before), "spread": spread}


def _spread(rig: Rig, r: Record) -> float:
    return float(np.std(r.y[2 * rig.horizon :]))


def longest(records: Sequence[Record]) -> int:
    """Index of the longest recording."""
    return int(np.argmax([len(r.t) for r in records]))


def write(folder: Path, rig: Rig, given: Sequence[Record], kept_back: Sequence[Record]) -> None:
    """Write a case as the tool is given it: model.toml, rec1.csv, rec2.csv, .., and unseen.csv where one is kept back.

    Sidecars stay out: the control law that they may state is not the one that gives a changed command.

    Parameters
    ----------
    folder : Path
        For what the tool is given.
    rig : Rig
        Has the model.
    given, kept_back : sequence of Record
        What the tool is given, and what it is marked against.
    """
    write_text(folder / "model.toml", (rig.folder / "model.toml").read_bytes().decode())
    for i, r in enumerate(given, start=1):
        _write(folder / f"rec{i}.csv", r)
    if kept_back:
        _write(folder / "unseen.csv", kept_back[longest(kept_back)])


def _write(path: Path, r: Record) -> None:
    columns = {"t": r.t, "u": r.u, "y": r.y, **r.others}
    rows = np.column_stack(list(columns.values()))
    text = io.StringIO()
    np.savetxt(text, rows, fmt="%.12g", delimiter=",", header=",".join(columns), comments="")
    write_text(path, text.getvalue())


def conceal(seed: int, rigs: Sequence[Ready], folder: Path, answer_file: Path) -> None:
    """Make the case of a seed and write it, and its answer.

    Parameters
    ----------
    seed : int
        Of the case.
    rigs : sequence of Ready
        Those of the campaign.
    folder : Path
        For what the tool is given.
    answer_file : Path
        For the answer, elsewhere.
    """
    made = make(seed, rigs)
    write(folder, made.ready.rig, made.given, made.kept_back)
    write_text(answer_file, json.dumps(answer(made, seed), indent=1))


def keep_as_recorded(ready: Ready, folder: Path, answer_file: Path) -> None:
    """Write a rig's recordings as they are, as a case; its answer says what is needed to mark against it.

    Parameters
    ----------
    ready : Ready
        The rig.
    folder : Path
        For its recordings.
    answer_file : Path
        For the answer, elsewhere.
    """
    rig = ready.rig
    write(folder, rig, rig.given, rig.kept_back)
    spread = _spread(rig, rig.kept_back[longest(rig.kept_back)]) if rig.kept_back else None
    said = {"kind": "as recorded", "rig": rig.name, "horizon": rig.horizon * rig.Ts, "spread": spread}
    write_text(answer_file, json.dumps(said, indent=1))
