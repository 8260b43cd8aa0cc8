"""Small recordings and plants to try things on, and the examples of the three papers."""

from __future__ import annotations

from typing import Any

import numpy as np

from autotune.arguments import number
from autotune.errors import InputError
from autotune.models import TransferFunction
from autotune.recording import Recording

#: [LM] (23), the ball in an air tube.
BALL = TransferFunction(num=(-65.5,), den=(2.02e-5, 0.007328, 0.3836, 1.0, 0.0))
#: [P] section IV, in ascending powers of the delay operator.
LOOP_PLANT = (0.0, 0.98e-3, 12.99e-3, 18.59e-3, 3.3e-3, -0.02e-3), (1.0, -4.4, 8.09, -7.83, 4.0, -0.86)
LOOP_NOISE = (1.0, -2.1, 1.45, -0.315, -0.0146, 0.0034)
LOOP_CONTROLLER = (0.63, -2.083, 2.8222, -1.865, 0.4978), (1.0, -2.65, 3.11, -1.75, 0.39)


def example(name: str, *, noise: float | None = None, seed: int = 0) -> Any:
    """Return something to try things on.

    Parameters
    ----------
    name : {"oven", "ball", "loop", "delay", "two delays"}
        An oven's recording in open loop (gain 2, lags of 2 and 3 s, dead time 0.5 s); plant (23) of the ball in a tube;
        a recording of the loop of Pouliquen et al. with r; recordings of Examples 2 and 3 of Ollivier et al.
    noise : float, optional
        Standard deviation of the noise [y unit], of the innovations in the loop; the paper's or a small one when
        absent.
    seed : int
        Of the noise and the excitation.

    Returns
    -------
    Recording or TransferFunction

    Examples
    --------
    >>> import autotune as at
    >>> at.example("oven").name
    'oven'
    """
    makers = {"oven": _oven, "loop": _loop, "delay": _delay, "two delays": _two_delays}
    if isinstance(name, str) and name == "ball":
        return BALL
    if not isinstance(name, str) or name not in makers:
        raise InputError(f"no example {name!r}"[:200], where="example", remedy=f"one of ball, {', '.join(makers)}")
    if noise is not None and number(noise, name="noise", where="example") < 0.0:
        raise InputError(f"noise = {noise!r}", where="example", remedy="a standard deviation is not negative")
    seed = int(number(seed, name="seed", where="example", above=-1, whole=True))
    return makers[name](noise, np.random.default_rng(seed))


def _oven(noise: float | None, rng: np.random.Generator) -> Recording:
    from scipy.signal import lsim

    t = np.arange(3000, dtype=np.float64) * 0.1
    u = np.repeat(rng.choice([4.5, 5.5], 300), 10)
    late = np.concatenate([np.full(5, u[0]), u[:-5]])
    y = 50.0 + lsim(([2.0], [6.0, 5.0, 1.0]), late - 5.0, t, interp=False)[1]
    y = y + (0.02 if noise is None else noise) * rng.standard_normal(t.size)
    units = {"units": {"u": "kW", "y": "degC"}}
    return Recording(t=t, u=u, y=y, metadata=units, name="oven")


def _loop(noise: float | None, rng: np.random.Generator) -> Recording:
    from scipy.signal import lfilter

    rows, burn_in = 1229, 2000
    r, e = rng.standard_normal((2, rows + burn_in))
    e = e * (1.0 / 3.0 if noise is None else noise)
    (b, a), (d, c) = LOOP_PLANT, LOOP_CONTROLLER
    whole = np.convolve(a, c) + np.convolve(b, d)
    y = lfilter(np.convolve(b, c), whole, r) + lfilter(np.convolve(LOOP_NOISE, c), whole, e)
    u = lfilter(np.convolve(a, c), whole, r) - lfilter(np.convolve(LOOP_NOISE, d), whole, e)
    kept = slice(burn_in, None)
    return Recording(t=np.arange(rows, dtype=np.float64), u=u[kept], y=y[kept], extra={"r": r[kept]}, name="loop")


def _delay(noise: float | None, rng: np.random.Generator) -> Recording:
    from scipy.integrate import solve_ivp

    def u_of(t: Any) -> Any:
        return 60.0 * np.cos(1.23 * t + 0.33 * np.sin(t) - 0.47 * np.cos(0.5 * t))

    t = np.arange(52501, dtype=np.float64) / 500.0
    slope = lambda s, x: [x[1], -1.2 * x[1] - 0.35 * x[0] + 2.0 * float(u_of(s - 4.0))]  # noqa: E731
    x = solve_ivp(slope, (0.0, 105.0), [20.0, 0.3], t_eval=t, rtol=1e-8, atol=1e-8, max_step=0.2).y[0]
    y = x + (5.0 if noise is None else noise) * rng.standard_normal(t.size)
    return Recording(t=t, u=u_of(t), y=y, metadata={"hold": "linear"}, name="delay")


def _two_delays(noise: float | None, rng: np.random.Generator) -> Recording:
    t = np.arange(40000, dtype=np.float64) / 500.0
    u = (-0.75 * np.sin((t + 4) / 2) - 2 / 9 * np.cos((t + 4) / 3)) / 1.5
    u = u + 2.7 / 1.5 * (3 * np.sin((t + 2) / 2) + 2 * np.cos((t + 2) / 3))
    y = 3 * np.sin(t / 2) + 2 * np.cos(t / 3) + (0.1 if noise is None else noise) * rng.standard_normal(t.size)
    return Recording(t=t, u=u, y=y, metadata={"hold": "linear"}, name="two delays")
