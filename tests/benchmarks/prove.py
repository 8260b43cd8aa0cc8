"""Proof on concealed cases, and the same files given to three simpler tools.

``python -m tests.benchmarks prove`` runs AUTOTUNE_PROVE_CASES cases (8; the full proof is 600 and takes hours of
processor time) in the folder AUTOTUNE_PROVE_OUT, or a temporary one. An interrupted folder is continued.
PySINDy is a library of its own: ``pip install pysindy``.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter, savgol_filter

from autotune.batch.engine import cluster, run_all
from autotune.diagnosis.selection.chain_proposals import search_chain
from autotune.diagnosis.selection.hypothesis import hypothesis
from autotune.model_tables import read_model
from autotune.recording import read_recording
from sim.proof import Campaign, conceal, diagnose, forecast_nrmse, mark_all, seal
from sim.score import confusion, table, wilson

#: What a term of the regression would be called, were it physics.
MECHANICAL = {
    "1": ("actuator.offset", lambda x, v, w: np.ones_like(x)),
    "v": ("", lambda x, v, w: v),
    "w": ("", lambda x, v, w: w),
    "x": ("plant.leak", lambda x, v, w: x),
    "x^2": ("", lambda x, v, w: x**2),
    "x^3": ("plant.cubic_stiffness", lambda x, v, w: x**3),
    "|v|v": ("plant.quadratic_drag", lambda x, v, w: np.abs(v) * v),
    "sign(v)": ("plant.coulomb_friction", lambda x, v, w: np.sign(v)),
    "w^2": ("actuator.nonlinear_gain", lambda x, v, w: w**2),
    "x w": ("plant.position_dependent_gain", lambda x, v, w: x * w),
}
LEVEL = {
    "1": ("", lambda y, w: np.ones_like(y)),
    "y": ("", lambda y, w: y),
    "w": ("", lambda y, w: w),
    "y^2": ("plant.sqrt_outflow", lambda y, w: y**2),
    "y^3": ("plant.radiation_loss", lambda y, w: y**3),
    "w^2": ("actuator.nonlinear_gain", lambda y, w: w**2),
    "y w": ("actuator.nonlinear_gain", lambda y, w: y * w),
}
SMOOTHING = 0.2
THRESHOLDS = (0.003, 0.01, 0.03, 0.1, 0.3)


@dataclass(frozen=True, kw_only=True)
class Smoothed:
    """One recording as the regression sees it: states, their rates, the lagged and delayed command."""

    states: np.ndarray
    rates: np.ndarray
    w: np.ndarray
    y: np.ndarray
    Ts: float


def smoothed(case: Path, name: str, model: dict[str, Any], answer: dict[str, Any]) -> Smoothed:
    """Prepare a recording; lag and delay of the actuator are given to the regression, which is generous."""
    rows = np.loadtxt(case / f"{name}.csv", delimiter=",", skiprows=1)
    Ts = answer["Ts"]
    u, y = rows[:, 1] - model["input"]["offset"], rows[:, 2] - model["output"]["offset"]
    actuator, body = model["block"][0], model["block"][1]
    late = round(actuator.get("delay", 0.0) / Ts)
    keep = np.exp(-Ts / actuator["den"][0])
    u = np.concatenate([np.full(late, u[0]), u[: len(u) - late]])
    w = lfilter([0.0, 1.0 - keep], [1.0, -keep], u, zi=[u[0] * keep])[0]
    span = 2 * (half_window(body["den"][0], Ts)) + 1
    x = [savgol_filter(y, span, 3, deriv=d, delta=Ts) for d in (0, 1, 2)]
    if answer["rig"] == "process":
        return Smoothed(states=np.column_stack(x[:1]), rates=np.column_stack(x[1:2]), w=w, y=y, Ts=Ts)
    return Smoothed(states=np.column_stack(x[:2]), rates=np.column_stack(x[1:3]), w=w, y=y, Ts=Ts)


def half_window(tau: float, Ts: float) -> int:
    """Half the width of the smoothing window in rows, SMOOTHING times the plant's time constant."""
    return max(3, round(SMOOTHING * tau / Ts))


def fit_sindy(train: list[Smoothed], library: dict[str, Any]) -> np.ndarray:
    """Coefficients of the last state's rate, the threshold chosen on the last third of each recording."""
    import pysindy as ps

    def fitted(threshold: float, parts: list[slice]) -> np.ndarray:
        features = ps.CustomLibrary(library_functions=[f for _, f in library.values()], function_names=None)
        model = ps.SINDy(
            feature_library=features, optimizer=ps.STLSQ(threshold=threshold, alpha=1e-6, normalize_columns=True)
        )
        model.fit(
            [s.states[p] for s, p in zip(train, parts, strict=True)],
            t=train[0].Ts,
            x_dot=[s.rates[p] for s, p in zip(train, parts, strict=True)],
            u=[s.w[p, None] for s, p in zip(train, parts, strict=True)],
        )
        return model.coefficients()[-1]

    early = [slice(0, 2 * len(s.y) // 3) for s in train]
    best = []
    for threshold in THRESHOLDS:
        scale = float(np.std(np.concatenate([s.rates[:, -1] for s in train])))
        c = fitted(threshold * scale * np.sqrt(sum(2 * len(s.y) // 3 for s in train)), early)
        e = np.concatenate(
            [s.rates[p.stop :, -1] - terms(s, library)[p.stop :] @ c for s, p in zip(train, early, strict=True)]
        )
        best.append(float(np.mean(e**2)))
    choice = max(i for i, error in enumerate(best) if error <= 1.01 * min(best))
    scale = float(np.std(np.concatenate([s.rates[:, -1] for s in train])))
    return fitted(THRESHOLDS[choice] * scale * np.sqrt(sum(len(s.y) for s in train)), [slice(None) for _ in train])


def terms(s: Smoothed, library: dict[str, Any]) -> np.ndarray:
    """Library evaluated on a recording."""
    columns = [*s.states.T, s.w]
    return np.column_stack([f(*columns) for _, f in library.values()])


def sindy_name(train: list[Smoothed], library: dict[str, Any], c: np.ndarray) -> str:
    """Name of the physics of the largest term beyond the linear ones; empty if there is none."""
    size = np.std(np.vstack([terms(s, library) for s in train]), axis=0) * np.abs(c)
    ranked = sorted(zip(size, (name for name, _ in library.values()), strict=True), reverse=True)
    return next((name for amount, name in ranked if name and amount > 0.0), "")


def sindy_runs(s: Smoothed, library: dict[str, Any], c: np.ndarray, start: np.ndarray, first: np.ndarray, rows: int):
    """Free runs of the regression's model from states ``start`` (order, windows) at rows ``first``."""
    functions = [f for _, f in library.values()]
    limit = 10.0 * np.max(np.abs(s.y))
    state, out = start.copy(), np.empty((len(first), rows))
    for i in range(rows):
        out[:, i] = state[0]
        w = s.w[np.minimum(first + i, len(s.y) - 1)]
        rate = sum(k * f(*state, w) for k, f in zip(c, functions, strict=True))
        if len(state) == 2:
            state[1] = np.clip(state[1] + s.Ts * rate, -1e6, 1e6)
            rate = state[1]
        state[0] = np.clip(state[0] + s.Ts * rate, -limit, limit)
    return out


def sindy_forecast(s: Smoothed, library: dict[str, Any], c: np.ndarray, H: int) -> float:
    """Forecast error over the standard deviation; the state is fitted to one horizon of the past, as for the others."""
    first = np.arange(H, len(s.y) - H, H)
    past = np.array([s.y[k : k + H] for k in first])
    start = s.states[first].T.copy()
    step = 1e-3 * np.std(s.states, axis=0)
    for _ in range(3):
        base = sindy_runs(s, library, c, start, first, H)
        slopes = []
        for j in range(len(start)):
            moved = start.copy()
            moved[j] += step[j]
            slopes.append((sindy_runs(s, library, c, moved, first, H) - base) / step[j])
        for k in range(len(first)):
            J = np.column_stack([slope[k] for slope in slopes])
            start[:, k] += np.linalg.lstsq(J, past[k] - base[k], rcond=None)[0]
    runs = sindy_runs(s, library, c, start, first, 2 * H)[:, H:]
    ahead = first[:, None] + H + np.arange(H)
    inside = ahead < len(s.y)
    e = (s.y[np.minimum(ahead, len(s.y) - 1)] - runs)[inside]
    return float(np.sqrt(np.mean(e**2)) / np.std(s.y[2 * H :]))


def criterion_only(case: Path) -> tuple[str, float]:
    """Effect of the single with the best Bayesian information criterion and its weight; empty where none is better.

    The fits are this tool's own; what is left out are held-out data, adequacy test and calibration.
    """
    recordings = [read_recording(case / f"{name}.csv") for name in ("rec1", "rec2")]
    good = [np.isfinite(r.y) for r in recordings]
    found = search_chain(read_model(case / "model.toml"), recordings, good)
    ranked = sorted((hypothesis(j.fit) for j in found.judged if len(j.names) < 2), key=lambda h: h.penalised_chi2)
    weight = 1.0 / sum(np.exp(0.5 * (ranked[0].penalised_chi2 - h.penalised_chi2)) for h in ranked)
    return "+".join(ranked[0].names), float(weight)


def compare(campaign: Campaign) -> list[dict[str, Any]]:
    """Give the same files to the simpler tools; one record of names and forecast errors per case."""
    rows = []
    for seed in campaign.seeds:
        case, answer = campaign.case(seed), json.loads(campaign.answer(seed).read_text(encoding="utf-8"))
        model = tomllib.loads((case / "model.toml").read_text(encoding="utf-8"))
        library = LEVEL if answer["rig"] == "process" else MECHANICAL
        train = [smoothed(case, name, model, answer) for name in ("rec1", "rec2")]
        c = fit_sindy(train, library)
        H = round(answer["horizon"] / answer["Ts"])
        error = sindy_forecast(smoothed(case, "unseen", model, answer), library, c, H)
        simulated = campaign.diagnosis(seed) / "unseen_sim.csv"
        extended = forecast_nrmse(case / "unseen.csv", simulated, answer) if simulated.exists() else np.nan
        name, weight = criterion_only(case)
        rows.append(
            {
                "answer": answer,
                "sindy": error,
                "sindy_name": sindy_name(train, library, c),
                "criterion_name": name,
                "criterion_weight": weight,
                "extended": extended,
            }
        )
    return rows


def print_comparison(rows: list[dict[str, Any]], marks: list[Any]) -> None:
    """Print medians of the forecast error, names and false alarms side by side."""
    better = [r for r in rows if r["answer"]["improvable"]]
    print(f"\nforecast of the unseen recording, median error / sd over {len(better)} improvable cases")
    for name in ("nominal", "retuned"):
        print(f"  {name + ' linear model':24s} {np.median([r['answer']['nrmse_unseen'][name] for r in better]):.4f}")
    print(f"  {'PySINDy':24s} {np.median([r['sindy'] for r in better]):.4f}")
    print(f"  {'extended model':24s} {np.nanmedian([r['extended'] for r in better]):.4f}")
    print(f"  {'perfect model':24s} {np.median([r['answer']['nrmse_unseen']['truth'] for r in better]):.4f}")
    print(f"\n{'':44s}{'this tool':>20s}{'criterion only':>20s}{'PySINDy':>20s}")
    for label, kind in (("singles: right name first", "single"), ("outside: an effect named all the same", "outside")):
        group = [(r, m) for r, m in zip(rows, marks, strict=True) if r["answer"]["kind"] == kind]
        own = [m.first_right if kind == "single" else m.verdict == "effect" for _, m in group]
        print(f"{label:44s}{share(own):>20s}" + "".join(f"{share(others(group, k, kind)):>20s}" for k in OTHERS))
    clean = [(r, m) for r, m in zip(rows, marks, strict=True) if r["answer"]["kind"] == "clean"]
    own = [m.verdict in ("effect", "unexplained") for _, m in clean]
    print(f"{'clean: physics named all the same':44s}{share(own):>20s}", end="")
    print("".join(f"{share(others(clean, k, 'clean')):>20s}" for k in OTHERS))
    wrong = [r["criterion_weight"] for r in rows if r["answer"]["kind"] == "outside" and r["criterion_name"]]
    if wrong:
        print(f"criterion only, outside the catalogue: median weight of the wrong name {np.median(wrong):.4f}")


OTHERS = ("criterion_name", "sindy_name")


def others(group: list[Any], key: str, kind: str) -> list[bool]:
    """Say of each case whether a simpler tool names it rightly (single) or names anything (else)."""
    if kind == "single":
        return [r[key] in r["answer"]["effects"][0]["accept"] for r, _ in group]
    return [bool(r[key]) for r, _ in group]


def share(hits: list[bool]) -> str:
    """Share with its interval."""
    low, high = wilson(sum(hits), len(hits))
    return f"{sum(hits)}/{len(hits)} ({100 * low:.0f}-{100 * high:.0f} %)"


def main() -> None:
    """Run the campaign and print its tables."""
    cases = int(os.environ.get("AUTOTUNE_PROVE_CASES", "8"))
    out = Path(os.environ.get("AUTOTUNE_PROVE_OUT", "") or tempfile.mkdtemp(prefix="autotune-prove-"))
    seeds = range(100_000, 100_000 + cases)
    campaign = Campaign(out=out, seeds=seeds, tool=(sys.executable, "-m", "autotune.cli"))
    for _ in conceal(campaign):
        pass
    print(f"{cases} cases in {out}, answers sealed: SHA-256 {seal(campaign)}")
    with cluster(processes=False) as client:
        for _, failure in run_all(client, partial(diagnose, campaign), {str(seed): seed for seed in seeds}):
            assert failure is None, failure
    marks = mark_all(campaign, list(seeds))
    for row in table(marks):
        interval = f"({100 * row.interval[0]:.0f}-{100 * row.interval[1]:.0f} %)" if row.interval else ""
        print(f"  {row.figure:50s} {row.asked:8s} {row.value:7.3f} {interval:12s} of {row.count}")
    for name, count, right, said in confusion(marks):
        print(f"  {name:34s} {right}/{count}  {', '.join(f'{word} {times}' for word, times in said)}")
    try:
        import pysindy  # noqa: F401  # only asked whether it is there
    except ImportError:
        print("\nno comparison: pip install pysindy")
        return
    print_comparison(compare(campaign), marks)
