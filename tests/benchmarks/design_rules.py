"""This tool's PI against the rules engineers use, on the ball and on the Astrom-Hagglund test batch.

Every rule's controller is judged by its own margins and gain: the tool designs with exactly those as constraints, so
its norm (11) can only be smaller or equal. ``BATCH=full`` in the environment takes every plant of the batch.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator

import numpy as np

from autotune.controller import PIDController
from autotune.design.margins import margins
from autotune.design.specification import Specification, spec1
from autotune.design.synthesis import design
from autotune.errors import DesignError
from autotune.models import TransferFunction
from tests.autotune.design.plants import BALL
from tests.autotune.design.tuning_rules import RULES


def batch(full: bool) -> Iterator[tuple[str, TransferFunction]]:
    """Yield the test batch of Astrom & Hagglund (2004), all of it or one plant in four."""
    lags = [0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.3, 1.5, 2, 4, 6, 8, 10, 20, 50, 100, 200, 500]
    step = 1 if full else 5
    for T in lags[::step]:
        yield f"P1 T={T:g}", TransferFunction(num=(1.0,), den=(T, 1.0), delay_s=1.0)
        yield f"P2 T={T:g}", TransferFunction(num=(1.0,), den=(T * T, 2.0 * T, 1.0), delay_s=1.0)
    for T in [0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 2, 5, 10][:: 1 if full else 3]:
        yield f"P3 T={T:g}", TransferFunction(num=(1.0,), den=_product([1.0, T, T]))
    for n in range(3, 9) if full else (3, 5, 8):
        yield f"P4 n={n}", TransferFunction(num=(1.0,), den=_product([1.0] * n))
    for a in np.arange(0.1, 0.95, 0.1 if full else 0.4):
        yield f"P5 a={a:.1f}", TransferFunction(num=(1.0,), den=_product([1.0, a, a**2, a**3]))
    for L in [0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0] if full else [0.05, 0.3, 1.0]:
        yield f"P6 L={L:g}", TransferFunction(num=(1.0,), den=(*_product([1.0 - L]), 0.0), delay_s=L)
    for T in (1, 2, 5, 10) if full else (2, 10):
        for L in [0.01, 0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0] if full else [0.1, 0.7]:
            yield f"P7 T={T} L={L:g}", TransferFunction(num=(float(T),), den=_product([T, 1.0 - L]), delay_s=L)
    for a in np.arange(0.1, 1.15, 0.1 if full else 0.5):
        yield f"P8 a={a:.1f}", TransferFunction(num=(-a, 1.0), den=_product([1.0] * 3))
    for T in np.arange(0.1, 1.05, 0.1 if full else 0.4):
        den = np.polymul([1.0, 1.0], [T * T, 1.4 * T, 1.0])
        yield f"P9 T={T:.1f}", TransferFunction(num=(1.0,), den=tuple(den))


def _product(constants: list[float]) -> tuple[float, ...]:
    den = np.array([1.0])
    for T in constants:
        den = np.polymul(den, [T, 1.0])
    return tuple(den)


def absolute_error(plant: TransferFunction, controller: PIDController, crossover: float) -> float:
    """Integral of the absolute output after a unit step disturbance at the input, by stepping the closed loop."""
    dt = 0.02 / crossover
    steps = min(int(30.0 * max(controller.Ti_s, 1.0 / crossover) / dt), 200_000)
    omega = np.pi / (steps * dt) * np.arange(1, 40 * 400, 2)  # odd harmonics of a square wave that jumps by 1
    H, C = plant.response(omega), controller.response(omega)
    spectrum = np.zeros(2 * len(omega) + 1, dtype=complex)
    spectrum[1::2] = H / (1.0 + H * C) * 2.0 / (np.pi * np.arange(1, 40 * 400, 2)) / 2.0
    y = -np.imag(np.fft.fft(np.conj(spectrum), 1 << 16)) * 2.0
    half = y[: 1 << 15]
    return float(np.sum(np.abs(half)) * steps * dt / (1 << 15))


def _row(name: str, c: PIDController, plant: TransferFunction) -> tuple[str, float]:
    m = margins(plant, c)
    if not m.stable:
        return f"  {name:28s} {c.K:9.4g} {c.Ti_s:8.3g}   unstable", math.nan
    asked = Specification(
        modulus_margin=min(m.modulus, 0.999),
        phase_margin_rad=min(m.phase_rad, math.radians(89.9)),
        noise_gain=abs(c.K) / min(m.modulus, 0.999) * (1.0 + 1e-9),
    )
    ratio = design(plant, asked, certificate=False).h2 / m.h2
    error = absolute_error(plant, c, m.crossover_rad_s if math.isfinite(m.crossover_rad_s) else 1.0 / c.Ti_s)
    return (
        f"  {name:28s} {c.K:9.4g} {c.Ti_s:8.3g} {m.h2:9.4g} {error:9.4g} {m.modulus:6.3f} "
        f"{math.degrees(m.phase_rad):6.1f} {m.noise_gain_bound:9.3g} {ratio:8.4f}"
    ), ratio


def main() -> None:
    full = os.environ.get("BATCH") == "full"
    columns = f"{'K':>9s} {'Ti':>8s} {'H2':>9s} {'IAE':>9s} {'M_m':>6s} {'deg':>6s} {'noise':>9s} {'tool/it':>8s}"
    header = f"  {'rule':28s} {columns}"
    print("tool/it: H2 of this tool's PI under the rule's own margins and gain, divided by the rule's H2")
    worst: dict[str, list[float]] = {name: [] for name in RULES}
    unstable, spent = dict.fromkeys(RULES, 0), []
    for plant_name, plant in [("ball (23)", BALL), *batch(full)]:
        shown = plant_name == "ball (23)" or plant_name in ("P1 T=1", "P4 n=5", "P6 L=0.3")
        if shown:
            print(f"{plant_name}\n{header}")
        for name, rule in RULES.items():
            try:
                text, ratio = _row(name, rule(plant), plant)
            except DesignError as error:
                text, ratio = f"  {name:28s} {error}", math.nan
            else:
                unstable[name] += math.isnan(ratio)
                worst[name].append(ratio)
            if shown:
                print(text)
        for certificate in (False, True):
            start = time.process_time()
            found = design(plant, spec1(0.1 if plant is BALL else 10.0), certificate=certificate)
            spent.append((certificate, time.process_time() - start, found.gap))
        if shown:
            print(_row("this tool, Spec1", found.controller, plant)[0])
    print("over the batch: H2 of the tool relative to the rule's under equal constraints (above 1 would be a loss)")
    for name, ratios in worst.items():
        known = np.array([r for r in ratios if not math.isnan(r)])
        print(f"  {name:28s} {len(known):4d} plants, median {np.median(known):.3f}, largest {known.max():.5f}", end="")
        print(f", {unstable[name]} unstable" if unstable[name] else "")
    for certificate in (False, True):
        times = 1e3 * np.array([t for c, t, _ in spent[2:] if c == certificate])
        word = "with" if certificate else "without"
        high = np.percentile(times, 95)
        print(f"  CPU per PI design {word} certificate: median {np.median(times):.0f} ms, 95 % {high:.0f} ms")
    gaps = 100.0 * np.array([gap for c, _, gap in spent if c and gap is not None])
    print(f"  certificate's gap: median {np.median(gaps):.2f} %, largest {gaps.max():.2f} %")


if __name__ == "__main__":
    main()
