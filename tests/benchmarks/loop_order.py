"""Which loop order the indirect method should take: the plant's, the plant's and the controller's, or what is seen.

``python -m tests.benchmarks loop_order``: seven loops, eight recordings each. What is seen is the number of singular
values of (8), whitened with the noise of Y_f, above the edge sqrt(f) + sqrt(2 f) of those of pure noise, between n and
n + n_c. ``LOOP_ORDER_ROWS`` in the environment holds the lengths, 2000 and 20000 rows by default.
"""

from __future__ import annotations

import os

import numpy as np
from scipy.signal import lfilter

import autotune.identification.closed_loop.subspace_indirect as indirect
from autotune.arrays import FloatArray
from autotune.identification.closed_loop.state_space import from_polynomials
from tests import loop_example as example

SEEDS, BURN_IN = 8, 2000
OMEGA = np.geomspace(0.01, 2.5, 40)


def _loop(num: object, den: object, noise: object, law: tuple[object, object], sd: float) -> dict[str, FloatArray]:
    size = np.size(den)
    polynomials = {"num": num, "den": den, "noise": noise, "law_num": law[0], "law_den": law[1], "sd": sd}
    loop = {name: np.atleast_1d(np.asarray(value, dtype=np.float64)) for name, value in polynomials.items()}
    return loop | {name: np.pad(loop[name], (size - loop[name].size, 0)) for name in ("num", "noise")}


RESONANT = np.convolve(np.real(np.poly(0.97 * np.exp([0.3j, -0.3j]))), [1.0, -0.8])
LOOPS = {
    "the paper's": _loop(
        example.PLANT_NUM, example.PLANT_DEN, example.NOISE_NUM,
        (example.CONTROLLER_NUM, example.CONTROLLER_DEN), example.VARIANCE**0.5,
    ),
    "lag, delay, PI": _loop(0.1, [1.0, -0.9, 0.0, 0.0], np.poly([0.5, 0.3, 0.0]), ([0.8, -0.736], [1.0, -1.0]), 0.1),
    "resonance, PID": _loop(
        [0.02, 0.015, 0.0], RESONANT, np.poly([0.6, 0.4, 0.2]), (0.3 * np.poly([0.95, 0.9]), np.poly([1.0, 0.3])), 0.1
    ),
    "servo, PID": _loop(
        [0.005, 0.0045], np.poly([1.0, 0.85]), np.poly([0.7, 0.2]), (2.0 * np.poly([0.99, 0.85]), np.poly([1.0, 0.4])),
        0.02,
    ),
    "unstable, lead": _loop(
        [0.02, 0.018], np.poly([1.03, 0.8]), np.poly([0.6, 0.3]), (6.0 * np.poly([0.8]), np.poly([0.2])), 0.05
    ),
    "three lags, PI": _loop(
        [0.0005, 0.0018, 0.0004], np.poly([0.97, 0.9, 0.7]), np.poly([0.8, 0.5, 0.0]), ([1.5, -1.455], [1.0, -1.0]), 0.1
    ),
    "two lags, order 4": _loop(
        [0.03, 0.02], np.poly([0.95, 0.7]), np.poly([0.5, 0.2]),
        (0.5 * np.poly([0.96, 0.7, 0.5, 0.3]), np.poly([1.0, 0.2, 0.52, 0.28])), 0.1,
    ),
}  # fmt: skip


def recorded(loop: dict[str, FloatArray], seed: int, rows: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return r, u and y of the loop u = r - C y, (rows, 1) each."""
    r, e = np.random.default_rng(seed).standard_normal((2, rows + BURN_IN)) * np.array([[1.0], [loop["sd"][0]]])
    den = np.polyadd(np.convolve(loop["den"], loop["law_den"]), np.convolve(loop["num"], loop["law_num"]))
    y = lfilter(np.convolve(loop["num"], loop["law_den"]), den, r)
    y = y + lfilter(np.convolve(loop["noise"], loop["law_den"]), den, e)
    u = lfilter(np.convolve(loop["den"], loop["law_den"]), den, r)
    u = u - lfilter(np.convolve(loop["noise"], loop["law_num"]), den, e)
    return r[BURN_IN:, None], u[BURN_IN:, None], y[BURN_IN:, None]


def seen(r: FloatArray, y: FloatArray, f: int) -> int:
    """Return how many whitened singular values of the first projection lie above those of noise."""
    R, rows = indirect.lagged_factor([(r, range(f)), (r, range(-f, 0)), (y, range(-f, 0)), (y, range(f))])
    on_past, noise = R[f : 3 * f, 3 * f :].T, R[3 * f :, 3 * f :].T
    values = np.linalg.svd(np.linalg.solve(noise / np.sqrt(rows), on_past), compute_uv=False)
    return int(np.sum(values > np.sqrt(f) + np.sqrt(2 * f)))


def main() -> None:
    """Print root mean square errors of poles and response, by loop, length and choice of the order."""
    for rows in map(int, os.environ.get("LOOP_ORDER_ROWS", "2000,20000").split(",")):
        for name, loop in LOOPS.items():
            n, n_c = loop["den"].size - 1, loop["law_den"].size - 1
            f = max(15, 2 * n + 6)
            plant = from_polynomials(loop["num"], loop["den"], loop["noise"], variance=1.0)
            markov = from_polynomials(loop["law_num"], loop["law_den"]).markov_parameters(f)
            errors: dict[str, list[tuple[float, float]]] = {"n": [], "n + n_c": [], "seen": []}
            for seed in range(SEEDS):
                r, u, y = recorded(loop, seed, rows)
                orders = {"n": n, "n + n_c": n + n_c, "seen": min(max(seen(r, y, f), n), n + n_c)}
                for choice, order in orders.items():
                    model = indirect.indirect_subspace(r, u, y, n, controller_markov=markov, f=f, loop_order=order)
                    pole = max(float(np.min(np.abs(model.poles - p))) for p in plant.poles)
                    ratio = model.response(OMEGA) / plant.response(OMEGA) - 1.0
                    errors[choice].append((pole, float(np.sqrt(np.mean(np.abs(ratio) ** 2)))))
            rms = {choice: np.sqrt(np.mean(np.square(values), axis=0)) for choice, values in errors.items()}
            print(f"{rows:7d} {name:18s}", *(f"{k}: {v[0]:.4f} {v[1]:.3f}  " for k, v in rms.items()), flush=True)


if __name__ == "__main__":
    main()
