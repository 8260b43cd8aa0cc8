"""Recordings of a drawn case with its effects at given sizes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from sim.conceal import excitation as excite
from sim.conceal.draw import Draw, RejectedError
from sim.conceal.effects import BALL, PROCESS, SERVO
from sim.conceal.loop import OPEN_LOOP, Law, Sampling, run_loop
from sim.conceal.physics import N_STATES, Floats, Physics
from sim.conceal.sizes import Scale, Sized


@dataclass(frozen=True, kw_only=True)
class Record:
    """One simulated recording, burn-in removed."""

    t: Floats
    u: Floats
    y: Floats
    noise: Floats
    acts: Floats
    lost: Floats
    spike: Floats
    r: Floats


def record(d: Draw, which: int, physics: Physics, sized: tuple[Sized, ...]) -> Record:
    """Simulate one recording with the effects at the given sizes.

    Parameters
    ----------
    d : Draw
        The case.
    which : int
        Place of the recording.
    physics : Physics
        Truth with the effects in it.
    sized : tuple of Sized
        What the effects do to rows and law.
    """
    rng = d.stream(10 + which)
    rig, ex = d.rig, d.excitations[which]
    N = rig.rows + rig.burn_in
    nominal_t = np.asarray((np.arange(N) - rig.burn_in) * rig.Ts, dtype=np.float64)
    white = rng.normal(size=N)
    noise = lfilter([np.sqrt(1.0 - d.rho**2)], [1.0, -d.rho], white)
    jitter, loses, spikes, signs = np.clip(rng.normal(size=N), -2, 2), rng.random(N), rng.random(N), rng.random(N)
    t, lost, spike, law = nominal_t.copy(), np.zeros(N), np.zeros(N), ex.law
    for s in sized:
        t = t + s.jitter * jitter
        for k in np.flatnonzero(loses < s.lost):
            lost[k : k + int(s.lost_rows)] = 1.0
        spike = spike + np.where(spikes < s.spikes, np.sign(signs - 0.5) * s.spike_size, 0.0)
        law = _change_law(law, s)
    lost[0] = 0.0
    sampling = Sampling(rig.Ts, t, noise * rig.noise_sd, lost, spike)
    u, y, _clean, acts = run_loop(physics, law, sampling, ex.r, ex.dither, rig.substeps, np.zeros(N_STATES))
    b = rig.burn_in
    reach = {BALL: 12.0, SERVO: 4.8 * rig.chain.K, PROCESS: 200.0 * rig.chain.K}[rig.rig]
    if not np.all(np.isfinite(y)) or np.ptp(y[b:]) > reach:
        raise RejectedError("the loop left its range")
    return Record(
        t=nominal_t[b:],
        u=np.array([excite.six(v) for v in u[b:]]),
        y=np.array([excite.six(v) for v in y[b:]]),
        noise=noise[b:] * rig.noise_sd,
        acts=acts[b:],
        lost=lost[b:],
        spike=spike[b:],
        r=ex.r[b:],
    )


def _change_law(law: Law, s: Sized) -> Law:
    changes = {name: getattr(law, name) * factor for name, factor in s.law.items()}
    return law._replace(**changes) if law.kind != OPEN_LOOP else law


def scale_of(d: Draw) -> Scale:
    """Sizes of the signals of the two given recordings without any effect."""
    records = [record(d, which, d.physics, ()) for which in (0, 1)]
    smooth = [np.diff(np.convolve(r.y, np.ones(20) / 20, "valid")) / d.rig.Ts for r in records]
    return Scale(
        du=float(np.mean([np.std(r.u) for r in records])),
        dy=float(np.mean([np.std(r.y) for r in records])),
        v=float(np.mean([np.std(v) for v in smooth])),
        length=d.rig.rows * d.rig.Ts,
        Ts=d.rig.Ts,
        noise=d.rig.noise_sd,
        unit_u=d.rig.unit_u,
        unit_y=d.rig.unit_y,
    )


def size_effects(d: Draw, sizes: tuple[float, ...], scale: Scale) -> tuple[Physics, tuple[Sized, ...]]:
    """Physics with the effects in it at the given sizes.

    Parameters
    ----------
    d : Draw
        The case.
    sizes : tuple of float
        One for each of its effects.
    scale : Scale
        What they are measured in.
    """
    physics, made = d.physics, []
    for i, (effect, size) in enumerate(zip(d.effects, sizes, strict=True)):
        sized = effect.make(size, physics, scale, d.stream(20 + i))
        physics = physics._replace(**sized.physics)
        if d.rig.rig == SERVO and "T_I" in sized.law:
            sized = replace(sized, law={"K": sized.law["T_I"]}, parameters={"K_factor": sized.parameters["T_I_factor"]})
        made.append(sized)
    return physics, tuple(made)
