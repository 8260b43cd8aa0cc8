"""Effects of the command, put in front of a recorded u: each gives the command that it turns into the recorded one.

Row by row; du is the command about the model's input offset.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sim.conceal.physics import Floats
from sim.recorded.readings import Put, Scale
from sim.recorded.rigs import Record, RefusedError

#: Smallest share of the rows on either side of a dead zone.
LEAST_SIDE = 0.05
#: Smallest share of a gain that drifts at a recording's end.
LEAST_GAIN = 0.2


def dead_zone(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Conceal sign(dv) max(abs(dv) - w, 0): the command before it was further out by w."""
    w = 0.2 * a * s.du

    def apply(r: Record, rng: np.random.Generator) -> Record:
        du = r.u - s.u0
        if min(np.mean(du > 0.0), np.mean(du < 0.0)) < LEAST_SIDE:
            raise RefusedError("the command stays on one side of the zone, where it is an offset")
        return replace(r, u=r.u + w * np.sign(du))

    return Put(apply=apply, parameters={"half_width": (w, s.unit_u)})


def nonlinear_gain(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Conceal dv + c dv^2: the command before it is the root of that."""
    c = float(rng.choice([-1.0, 1.0])) * 0.08 * a / s.du

    def apply(r: Record, rng: np.random.Generator) -> Record:
        inside = 1.0 + 4.0 * c * (r.u - s.u0)
        if np.min(inside) < 0.1:
            raise RefusedError("no command gives the recorded one through a gain bent as much")
        return replace(r, u=s.u0 + (np.sqrt(inside) - 1.0) / (2.0 * c))

    return Put(apply=apply, parameters={"second_order": (c, f"1/{s.unit_u}")})


def backlash(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Conceal play of half width w: the command before it leads by w in the direction of the last move."""
    w = 0.2 * a * s.du

    def apply(r: Record, rng: np.random.Generator) -> Record:
        return replace(r, u=r.u + w * directions(r.u))

    return Put(apply=apply, parameters={"half_width": (w, s.unit_u)})


def directions(u: Floats) -> Floats:
    """Sign of a command's last move at each row; before the first move, that of the first."""
    moves = np.sign(np.diff(u, prepend=u[0]))
    at = np.flatnonzero(moves)
    if not len(at):
        return np.zeros(len(u))
    last = np.maximum.accumulate(np.where(moves != 0.0, np.arange(len(u)), -1))
    return np.asarray(moves[np.where(last < 0, at[0], last)])


def lag(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Conceal a drive's filter u_k = k u_(k-1) + (1 - k) v_k, which puts out held values."""
    tau = 0.15 * a * s.tau
    keep = math.exp(-s.Ts / tau)

    def apply(r: Record, rng: np.random.Generator) -> Record:
        return replace(r, u=r.u + keep / (1.0 - keep) * np.diff(r.u, prepend=r.u[0]))

    return Put(apply=apply, parameters={"time_constant": (tau, "s")})


def gain_drift(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Conceal a gain 1 + rate t of du, t from a recording's first row on."""
    rate = float(rng.choice([-0.4, 0.6])) * a / s.length
    if not LEAST_GAIN < 1.0 + rate * s.length < 1.0 / LEAST_GAIN:
        raise RefusedError("the gain would all but vanish, or grow several times, within the recording")
    return Put(
        apply=lambda r, rng: replace(r, u=s.u0 + (r.u - s.u0) / (1.0 + rate * (r.t - r.t[0]))),
        parameters={"rate": (rate, "1/s")},
    )


def step_load(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Conceal a load, in units of the command, that begins at a time of every recording and stays."""
    size, share = float(rng.choice([-1.0, 1.0])) * 0.1 * a * s.du, float(rng.uniform(0.25, 0.6))

    def apply(r: Record, rng: np.random.Generator) -> Record:
        return replace(r, u=r.u - np.where(np.arange(len(r.u)) >= share * len(r.u), size, 0.0))

    return Put(apply=apply, parameters={"size": (size, s.unit_u), "share": (share, "-")})


def periodic_load(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Conceal a sinusoidal load in units of the command."""
    amplitude, hertz = 0.1 * a * s.du, float(rng.uniform(0.08, 0.4)) / s.tau
    phase = float(rng.uniform(0.0, 2.0 * np.pi))
    if hertz * s.Ts > 0.1:
        raise RefusedError("the load would swing within ten rows")

    def apply(r: Record, rng: np.random.Generator) -> Record:
        return replace(r, u=r.u - amplitude * np.sin(2.0 * np.pi * hertz * r.t + phase))

    return Put(apply=apply, parameters={"amplitude": (amplitude, s.unit_u), "frequency": (hertz, "Hz")})


def drifting_load(a: float, s: Scale, rng: np.random.Generator) -> Put:
    """Conceal a load, in units of the command, that grows at a constant rate from a recording's first row on."""
    rate = float(rng.choice([-1.0, 1.0])) * 0.1 * a * s.du / s.length
    return Put(
        apply=lambda r, rng: replace(r, u=r.u - rate * (r.t - r.t[0])), parameters={"rate": (rate, f"{s.unit_u}/s")}
    )
