"""What the page of Ollivier et al. 2007 is drawn from: estimates over noisy recordings, and the on-line examples."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from autotune.api.examples import example
from autotune.arrays import FloatArray
from autotune.identification.delay.identify import identify_delay
from autotune.identification.delay.methods import algebraic_delay
from autotune.identification.delay.modulated_delay import modulated_delay
from autotune.identification.delay.online_modulating import DelayTracking, follow
from autotune.identification.delay.two_delays import two_delays
from autotune.recording import Recording
from autotune.report.delay_tables import TABLE_1, TABLE_2, Followed

#: S of Example 2, and the twenty intervals of Example 3.
_INTERVALS = [(10.0 * k, 10.0 * k + 15.0) for k in range(1, 10)]
_INTERVALS_2 = [(15.0 + 2.0 * k, 25.0 + 2.0 * k) for k in range(20)]
#: Noises whose estimates the paper improves by least squares (its second table 1).
_STARRED = (5.0, 10.0)


def _noisy(clean: Recording, sd: float, seed: int) -> Recording:
    y = clean.y + sd * np.random.default_rng(seed).standard_normal(len(clean))
    return Recording(t=clean.t, u=clean.u, y=y, metadata=clean.metadata)


def one_delay_estimates(sets: Iterable[int]) -> dict[float, tuple[FloatArray, FloatArray, FloatArray | None]]:
    """Return a_1, a_0, b, h of Example 2 at each noise: the paper's way, weighted, and output error where starred.

    Those by output error have their standard deviations beside them, which are the Cramer-Rao bound's.

    Parameters
    ----------
    sets : iterable of int
        Seeds.

    Returns
    -------
    dict of float to two (sets, 4) arrays and one of (sets, 2, 4), None for noises that the paper does not improve
    """
    clean = example("delay", noise=0.0)
    rows: dict[float, tuple[list[list[float]], list[list[float]], list[list[FloatArray]]]] = {
        sd: ([], [], []) for sd in TABLE_1
    }
    for seed in sets:
        for sd, (paper, ours, best) in rows.items():
            record = _noisy(clean, sd, seed)
            found = modulated_delay(record, 2, _INTERVALS)
            paper.append([found.a[1], found.a[0], found.b, found.delay_s])
            weighted = algebraic_delay(record, 2, interval_s=15.0)
            ours.append([weighted.a[1], weighted.a[0], weighted.b, weighted.delay_s])
            if sd in _STARRED:
                model = identify_delay(record, 2, max_delay_s=12.0)
                given = [1, 0, 2, 3]
                best.append([model.values[given], model.standard_deviations[given]])
    return {sd: (np.array(p), np.array(w), np.array(b) if b else None) for sd, (p, w, b) in rows.items()}


def two_delay_estimates(sets: Iterable[int]) -> dict[float, tuple[FloatArray, FloatArray]]:
    """Return a, b, h_1, h_2 of Example 3 at each noise, by the paper's way and weighted, each (sets, 4)."""
    clean = example("two delays", noise=0.0)
    rows: dict[float, tuple[list[FloatArray], list[FloatArray]]] = {sd: ([], []) for sd in TABLE_2}
    for seed in sets:
        for sd, (paper, ours) in rows.items():
            record = _noisy(clean, sd, seed)
            paper.append(two_delays(record, _INTERVALS_2, polish=False).values)
            ours.append(two_delays(record, _INTERVALS_2).values)
    return {sd: (np.array(p), np.array(w)) for sd, (p, w) in rows.items()}


def followed_examples() -> tuple[Followed, ...]:
    """Return Examples 1, 4 and 5 on line, at noise 5; the paper prints no profile of Example 5's delay, a ramp here."""

    def drifting(s: float) -> float:
        return -1.2 if s < 30.0 else -1.2 - 0.02 * (s - 30.0)

    def ramp(s: float) -> float:
        return 3.6 + 0.01 * max(s - 40.0, 0.0)

    fourth, fifth = DelayTracking(after_s=14.0, rate=0.4), DelayTracking(start_s=3.6, after_s=40.0, rate=0.4)
    return (
        _follow("Example 1, figure 1", 50.0, drifting, lambda _: 0.0, 1e-3, None),
        _follow("Example 4, figure 2", 50.0, drifting, lambda _: 0.5, 4e-3, fourth),
        _follow("Example 5, figure 3", 120.0, lambda _: -1.2, ramp, 4e-4, fifth),
    )


def _follow(
    title: str,
    duration_s: float,
    a_1: Callable[[float], float],
    delay: Callable[[float], float],
    gain: float,
    tracking: DelayTracking | None,
) -> Followed:
    from scipy.integrate import solve_ivp

    def u_of(t: FloatArray | float) -> FloatArray:
        return np.asarray(60.0 * np.cos(1.23 * t + 1.3 * np.sin(t) - 0.7 * np.cos(0.5 * t)))

    def slope(s: float, x: FloatArray) -> list[float]:
        return [x[1], a_1(s) * x[1] - 0.35 * x[0] + 2.0 * float(u_of(s - delay(s)))]

    t = np.arange(round(100.0 * duration_s) + 1) / 100.0
    x = solve_ivp(slope, (0.0, t[-1]), [20.0, 0.3], t_eval=t, rtol=1e-8, atol=1e-8, max_step=0.2).y
    record = _noisy(Recording(t=t, u=u_of(t), y=x[0], metadata={"hold": "linear"}), 5.0, 0)
    paper = follow(record, 2, forgetting=1.0, gain=gain, delay=tracking)
    ours = follow(record, 2, forgetting=1.0, delay=tracking)
    true = np.array([[-0.35, a_1(s), 2.0, delay(s)] for s in t])
    return Followed(
        title=title,
        t=t,
        truth=true,
        state=x.T,
        paper=np.column_stack([paper.a, paper.b, paper.delay_s]),
        ours=np.column_stack([ours.a, ours.b, ours.delay_s]),
        paper_state=paper.state,
        delayed=tracking is not None,
    )
