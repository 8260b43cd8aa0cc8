"""Concealed cases: search the size that has the drawn strength, record, and keep the answer apart."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim.conceal.draw import Draw, RejectedError, draw
from sim.conceal.effects import PROCESS
from sim.conceal.physics import Floats, Physics
from sim.conceal.record import Record, record, scale_of, size_effects
from sim.conceal.retune import Chain, forecast_error, residuals, retune
from sim.conceal.rigs import FORMS, linear_truth, model_file
from sim.conceal.sizes import Scale, Sized
from sim.whole import write_text

FILES = ("rec1", "rec2", "unseen")
#: Bands of the retuned structure's rms residual over the noise.
STRENGTHS = {"weak": (1.025, 1.06), "medium": (1.08, 1.25), "strong": (1.45, 3.0)}
LAW_SIZES = {"weak": 0.5, "medium": 1.0, "strong": 2.5}
NUISANCE = ["actuator.offset", "environment.step_load"]
ACTS_AT_TIMES = ("plant.hard_stop", "actuator.saturation")


def _retuned_ratio(d: Draw, sizes: tuple[float, ...], scale: Scale) -> tuple[float, Chain]:
    """Rms residual of the retuned structure over the noise, and that structure."""
    physics, made = size_effects(d, sizes, scale)
    records = [record(d, which, physics, made) for which in (0, 1)]
    window = round(2.0 * d.rig.horizon / d.rig.Ts)
    chain, rms = retune(d.rig.chain, [(r.u, r.y) for r in records], d.rig.Ts, window, 2e-4)
    return rms / d.rig.noise_sd, chain


def _search_size(d: Draw, scale: Scale, low: float, high: float) -> float:
    """Size of a single effect at which the retuned rms residual lies in the band."""
    target = float(np.exp(d.stream(5).uniform(np.log(low), np.log(high))))
    size, below, above = 1.0, 0.0, np.inf
    for _ in range(12):
        try:
            ratio = _retuned_ratio(d, (size,), scale)[0]
        except RejectedError:
            ratio = np.inf
        if low <= ratio <= high and (abs(ratio - target) < 0.3 * (target - 1.0)):
            return size
        below, above = (size, above) if ratio < target else (below, size)
        guess = size * np.sqrt((target**2 - 1.0) / max(min(ratio, 10.0) ** 2 - 1.0, 1e-3))
        guess = float(np.clip(guess, size / 4.0, size * 4.0))
        inside = below < guess < above
        size = guess if inside else float(np.sqrt(max(below, above / 16.0) * min(above, max(below, 1e-3) * 16.0)))
        if size > 200.0 or size < 1e-3:
            break
    raise RejectedError("no size of the effect has the strength")


def _sizes_for(d: Draw, scale: Scale) -> tuple[float, ...]:
    """Sizes of the case's effects: by strength for one, each plainly visible alone for two."""
    if not d.effects:
        return ()
    if d.effects[0].name == "controller.law":
        return (LAW_SIZES[d.strength or "medium"],)
    if len(d.effects) == 1:
        return (_search_size(d, scale, *STRENGTHS[d.strength or "medium"]),)
    alone = [replace(d, effects=(effect,)) for effect in d.effects]
    return tuple(_search_size(one, scale, 1.12, 1.5) for one in alone)


def _windows_of(d: Draw, records: list[Record]) -> dict[str, list[list[float]]]:
    """List the times at which an effect that acts only at times does act."""
    names = {e.name for e in d.effects}
    out: dict[str, list[list[float]]] = {}
    for file, r in zip(FILES, records, strict=True):
        active = np.zeros(len(r.t), dtype=bool)
        if names & set(ACTS_AT_TIMES):
            active |= r.acts > 0.0
        active |= (r.lost > 0.0) | (r.spike != 0.0)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], active.astype(int), [0]])))
        pairs = [[round(float(r.t[a]), 4), round(float(r.t[b - 1]) + d.rig.Ts, 4)] for a, b in edges.reshape(-1, 2)]
        if pairs:
            out[file] = pairs[:60]
    return out


def _unseen_errors(d: Draw, r: Record, physics: Physics, retuned: Chain) -> dict[str, float]:
    """Forecast errors of the unseen recording over its standard deviation."""
    H = round(d.rig.horizon / d.rig.Ts)
    sd = float(np.std(r.y[2 * H :]))

    def score(e: Floats) -> float:
        return float(np.sqrt(np.mean(e**2))) / sd

    perfect = replace(linear_truth(physics), u_offset=0.0, y_offset=0.0)
    return {
        "nominal": score(forecast_error(d.rig.chain, r.u, r.y, d.rig.Ts, H)),
        "retuned": score(forecast_error(retuned, r.u, r.y, d.rig.Ts, H)),
        # a perfect model errs by the noise and by what noise did to its starting state
        "truth": score(forecast_error(perfect, np.zeros(len(r.u)), r.noise, d.rig.Ts, H)),
        "noise": score(r.noise[2 * H :]),
    }


def make(seed: int) -> tuple[Draw, list[Record], dict[str, Any]]:
    """Make the case of one seed: its draw, its three recordings and its answer."""
    for attempt in range(60):
        d = draw(seed, attempt)
        try:
            scale = scale_of(d)
            sizes = _sizes_for(d, scale)
            physics, made = size_effects(d, sizes, scale)
            records = [record(d, which, physics, made) for which in (0, 1, 2)]
            return d, records, _answer(d, records, physics, made)
        except RejectedError:
            continue
    raise RuntimeError(f"seed {seed} gives no usable case in 60 draws")


def _answer(d: Draw, records: list[Record], physics: Physics, made: tuple[Sized, ...]) -> dict[str, Any]:
    window = round(2.0 * d.rig.horizon / d.rig.Ts)
    train = [(r.u, r.y) for r in records[:2]]
    retuned, rms = retune(d.rig.chain, train, d.rig.Ts, window)
    nominal = np.concatenate([residuals(d.rig.chain, u, y, d.rig.Ts, window) for u, y in train])
    nominal_ratio = float(np.sqrt(np.mean(nominal**2))) / d.rig.noise_sd
    if d.kind == "parameters" and nominal_ratio < 1.15:
        raise RejectedError("the numbers are wrong by less than shows")
    errors = _unseen_errors(d, records[2], physics, retuned)
    clean = d.kind in ("exact", "coloured", "parameters")
    verdict = {"exact": "none", "coloured": "none", "parameters": "parameters", "outside": "unexplained"}
    places = {p for e in d.effects for p in (e.places if e.outside else (e.name.split(".")[0], *e.places))}
    return {
        "kind": "clean" if clean else d.kind,
        "sub": d.kind if clean else None,
        "rig": d.rig.rig,
        "verdict": verdict.get(d.kind, "effect"),
        "effects": [e.answer(s, d.rig.rig) for e, s in zip(d.effects, made, strict=True)],
        "places": sorted(places),
        "nuisance": NUISANCE if d.offset else [],
        "strength": d.strength,
        "improvable": bool(
            d.kind in ("single", "double")
            and all(e.forecastable for e in d.effects)
            and errors["retuned"] > 1.1 * errors["truth"]
        ),
        "excitation": [e.name for e in d.excitations],
        "noise_sd": d.rig.noise_sd,
        "noise_rho": d.rho,
        "Ts": d.rig.Ts,
        "rows": d.rig.rows,
        "horizon": d.rig.horizon,
        "windows": _windows_of(d, records),
        "truth_parameters": {name: one for name, one in asdict(linear_truth(physics)).items() if name != "integrating"},
        "nrmse_unseen": errors,
        "retuned_train_ratio": round(rms / d.rig.noise_sd, 4),
        "nominal_train_ratio": round(nominal_ratio, 4),
        "seed": d.seed,
    }


def write(seed: int, folder: Path, answer_file: Path) -> dict[str, Any]:
    """Write the case of one seed, and its answer.

    Parameters
    ----------
    seed : int
        Of the case.
    folder : Path
        For what the tool is given.
    answer_file : Path
        For the answer, elsewhere.
    """
    d, records, answer = make(seed)
    write_text(folder / "model.toml", model_file(d.rig, FORMS[seed % len(FORMS)]))
    digits = 1 if d.rig.rig == PROCESS else 3
    for name, ex, r in zip(FILES, d.excitations, records, strict=True):
        columns = [r.u, r.y, *([r.r] if ex.record_r else [])]
        rows = ["t,u,y,r" if ex.record_r else "t,u,y"]
        for k, t in enumerate(r.t):
            rows.append(f"{t:.{digits}f}," + ",".join(f"{c[k]:.6g}" for c in columns))
        write_text(folder / f"{name}.csv", "\n".join(rows) + "\n")
        stated = "".join(f"{k} = {json.dumps(v) if isinstance(v, str) else f'{v:g}'}\n" for k, v in ex.stated.items())
        units = f'[units]\nt = "s"\nu = "{d.rig.unit_u}"\ny = "{d.rig.unit_y}"\n'
        head = f'rig = "{d.rig.rig}"\nsample_time = {d.rig.Ts:g}\n'
        write_text(folder / f"{name}.toml", f"{head}{units}[controller]\n{stated}")
    write_text(answer_file, json.dumps(answer, indent=1))
    return answer
