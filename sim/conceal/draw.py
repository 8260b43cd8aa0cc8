"""Everything random of a concealed case, fixed by its seed before the strength is searched for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.conceal import excitation as excite
from sim.conceal.effects import BALL, EFFECTS, LOOPS, PROCESS, SERVO, Effect
from sim.conceal.excitation import EXCITATIONS, Excitation
from sim.conceal.physics import Floats, Physics
from sim.conceal.rigs import NominalRig, nominal_rig, truth

KINDS = {"exact": 0.06, "coloured": 0.04, "parameters": 0.1, "single": 0.54, "double": 0.14, "outside": 0.12}
RIGS = {BALL: 0.5, SERVO: 0.25, PROCESS: 0.25}
STRENGTHS = ("weak", "medium", "strong")
SAME_EFFECTS = 5
DRY = {"plant.coulomb_friction", "plant.stribeck_friction", "plant.hysteresis"}


class RejectedError(Exception):
    """A draw that gives no usable case; the next draw of the same seed is tried."""


@dataclass(frozen=True, kw_only=True)
class Draw:
    """Everything random of a case, fixed before the strength is searched for."""

    seed: int
    attempt: int
    kind: str
    strength: str | None
    rig: NominalRig
    physics: Physics
    rho: float
    offset: bool
    effects: tuple[Effect, ...]
    excitations: tuple[Excitation, Excitation, Excitation]

    def stream(self, purpose: int) -> np.random.Generator:
        """Random numbers for one purpose, the same whenever they are asked for."""
        return np.random.default_rng([self.seed, self.attempt, purpose])


def draw(seed: int, attempt: int) -> Draw:
    """Draw kind, strength, rig, effects and excitations of one case.

    Parameters
    ----------
    seed : int
        Of the case.
    attempt : int
        How many draws of it were rejected.
    """
    rng = np.random.default_rng([seed, attempt, 0])
    # kind, strength, rig and effects stay for a few rejected draws, so that effects hard to place are not crowded out
    fixed = np.random.default_rng([seed, attempt // SAME_EFFECTS, 99])
    kind = str(np.random.default_rng([seed, 98]).choice(list(KINDS), p=list(KINDS.values())))
    strength = str(fixed.choice(STRENGTHS)) if kind in ("single", "outside") else None
    if kind == "outside" and strength == "weak":
        strength = "medium"
    effects = _draw_effects(fixed, kind)
    rigs = [rig for rig in RIGS if all(rig in e.rigs for e in effects)]
    shares = np.array([RIGS[rig] for rig in rigs])
    rig_name = str(fixed.choice(rigs, p=shares / shares.sum()))
    variant = {BALL: "", SERVO: str(rng.choice(["rad", "mm"])), PROCESS: str(rng.choice(["level", "thermal"]))}[
        rig_name
    ]
    variant = next((e.variant for e in effects if e.variant), variant)
    rig = nominal_rig(rng, rig_name, variant)
    clean = kind in ("exact", "coloured")
    offset = bool(effects) and rig_name in LOOPS and rng.random() < 0.4 and effects[0].name != "actuator.offset"
    physics = truth(rng, rig, clean or (kind != "parameters" and rng.random() < 0.3), offset)
    names = list(EXCITATIONS[rig_name])
    if any(e.open_loop_only for e in effects):
        names = ["prbs", "steps", "prbs"]
    elif any(e.name == "controller.law" for e in effects):
        names = {BALL: ["pi_steps", "pi_rms", "pi_multisine"], SERVO: names[1:], PROCESS: ["pi", "pi", "prbs"]}[
            rig_name
        ]
    else:
        rng.shuffle(names)
    t = np.asarray((np.arange(rig.rows + rig.burn_in) - rig.burn_in) * rig.Ts, dtype=np.float64)
    excitations = tuple(_excitation(rng, rig, name, t) for name in names[:3])
    rho = float(rng.uniform(0.7, 0.9)) if kind == "coloured" else float(rng.choice([0.0, 0.5], p=[0.65, 0.35]))
    return Draw(
        seed=seed,
        attempt=attempt,
        kind=kind,
        strength=strength,
        rig=rig,
        physics=physics,
        rho=rho,
        offset=offset,
        effects=effects,
        excitations=excitations,  # type: ignore[arg-type]  # names[:3] makes three
    )


def _draw_effects(rng: np.random.Generator, kind: str) -> tuple[Effect, ...]:
    inside = [e for e in EFFECTS if not e.outside]
    if kind == "outside":
        return (_one(rng, [e for e in EFFECTS if e.outside]),)
    if kind == "single":
        return (_one(rng, inside),)
    if kind != "double":
        return ()
    simple = [e for e in inside if e.forecastable and not e.open_loop_only and e.name != "actuator.offset"]
    first = _one(rng, simple)
    fits = [
        e
        for e in simple
        if e is not first
        and set(e.rigs) & set(first.rigs)
        and not set(e.accept) & set(first.accept)
        and (not e.variant or not first.variant or e.variant == first.variant)
        and not ({e.name, first.name} <= DRY)
    ]
    return first, _one(rng, fits)


def _one(rng: np.random.Generator, effects: list[Effect]) -> Effect:
    return effects[int(rng.integers(len(effects)))]


def _excitation(rng: np.random.Generator, rig: NominalRig, name: str, t: Floats) -> Excitation:
    if rig.rig == BALL:
        return excite.ball(rng, name, t, rig.Ts)
    if rig.rig == SERVO:
        return excite.servo(rng, name, t, rig.Ts, rig.chain.K)
    return excite.process(rng, name, t, rig.Ts, rig.chain.K, rig.chain.u_offset, rig.chain.y_offset)
