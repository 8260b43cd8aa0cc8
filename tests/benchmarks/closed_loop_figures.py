"""Figures 2 to 5 of Pouliquen et al. 2011: estimated poles by each method, and the noise model's response.

``FIGURES=folder python -m tests.benchmarks closed_loop_figures`` writes ``folder/closed_loop_figures.html`` from 100
data sets of the paper's example (SETS in the environment for another number), with the default estimate beside them.
The paper draws other data: the clouds are to be compared, not their points.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import IdentificationError
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.report import chart as go
from autotune.report.chart import make_subplots
from autotune.report.page import BLUE, GREY, ORANGE, Figure, Page, Section, add_line, write_page
from tests.benchmarks.closed_loop import METHODS
from tests.loop_example import PLANT, example_set

#: Methods drawn: title, entry of the benchmark's table.
DRAWN = {
    "this paper": "paper's method, n_cl = 9",
    "Van Overschee-De Moor": "Van Overschee-De Moor 10/10",
    "Oku-Tanaka": "Oku-Tanaka 20/20",
    "SSARX": "SSARX p=30 f=10",
    "ORT": "ORT (Katayama) 20/20",
    "default": "default (polished)",
}
#: Frequencies of the noise model's response [rad/sample].
OMEGA = np.geomspace(0.01, np.pi, 300)


def estimates(count: int) -> dict[str, list[InnovationModel]]:
    """Return the models of every drawn method on the same data sets; those without a model are left out."""
    models: dict[str, list[InnovationModel]] = {title: [] for title in DRAWN}
    for seed in range(count):
        d = example_set(seed)
        for title, name in DRAWN.items():
            try:
                models[title].append(METHODS[name](d))
            except IdentificationError:
                continue
    return models


def poles_figure(models: Mapping[str, Sequence[InnovationModel]]) -> Any:
    """Draw the poles of each method's models in the upper half of the z plane, the true ones on top."""
    figure = make_subplots(rows=1, cols=len(models))
    circle = np.exp(1j * np.linspace(0.0, np.pi, 400))
    for col, (title, found) in enumerate(models.items(), start=1):
        poles = np.concatenate([model.poles for model in found])
        upper = poles[poles.imag >= 0.0]
        place: dict[str, Any] = {"row": 1, "col": col, "showlegend": col == 1}
        add_line(figure, circle.real, circle.imag, "unit circle", GREY, width=1.0, **place)
        _marks(figure, upper, "estimated", BLUE, "asterisk-open", 6, place)
        _marks(figure, PLANT.poles[PLANT.poles.imag >= 0.0], "plant", ORANGE, "cross-thin-open", 14, place)
        figure.update_xaxes(title=f"real part, {title} ({len(found)} sets)", row=1, col=col)
    figure.update_xaxes(range=[0.45, 1.12])
    figure.update_yaxes(range=[-0.05, 0.85])
    figure.update_yaxes(title="imaginary part", col=1)
    return figure


def _marks(
    figure: Any, poles: ComplexArray, name: str, colour: str, symbol: str, size: int, place: Mapping[str, Any]
) -> None:
    at = {key: place[key] for key in ("row", "col")}
    marker = {"color": colour, "symbol": symbol, "size": size, "line": {"width": 2 if size > 10 else 1}}
    show = place["showlegend"]
    trace = go.Scatter(x=poles.real, y=poles.imag, name=name, mode="markers", marker=marker, showlegend=show)
    figure.add_trace(trace, **at)


def noise_figure(models: Mapping[str, Sequence[InnovationModel]]) -> Any:
    """Draw sigma times the magnitude of H for each method's models, the true one on top."""
    figure = make_subplots(rows=1, cols=len(models))
    for col, (title, found) in enumerate(models.items(), start=1):
        # one trace for all sets, NaN between them, keeps the page small
        x = np.concatenate([np.append(OMEGA, np.nan) for _ in found])
        y = np.concatenate([np.append(_spectrum(model), np.nan) for model in found])
        place: dict[str, Any] = {"row": 1, "col": col, "showlegend": col == 1}
        add_line(figure, x, y, "estimated", BLUE, width=0.6, opacity=0.5, **place)
        add_line(figure, OMEGA, _spectrum(PLANT), "true", ORANGE, width=2.0, **place)
        figure.update_xaxes(title=f"frequency [rad/sample], {title}", row=1, col=col)
    figure.update_xaxes(type="log")
    figure.update_yaxes(type="log", range=[-1.5, 2.5])
    figure.update_yaxes(title="sigma |H|", col=1)
    return figure


def _spectrum(model: InnovationModel) -> FloatArray:
    sd = float(model.innovation_covariance[0, 0]) ** 0.5
    return np.asarray(sd * np.abs(model.noise_response(OMEGA)[:, 0, 0]), dtype=np.float64)


def page(models: Mapping[str, Sequence[InnovationModel]], count: int) -> Page:
    """Return the page with the figures."""

    def poles(title: str, caption: str, *names: str) -> Section:
        figure = poles_figure({name: models[name] for name in names})
        return Section(title=title, figures=(Figure(figure=figure, caption=caption, height_px=460),))

    return Page(
        title="Closed-loop subspace identification, the example of 2011",
        verdict=f"{count} data sets of 1229 samples: the indirect method beside its peers and the polished default.",
        tone="good",
        summary=("The lower half of the z plane is its mirror image.",),
        sections=(
            poles(
                "Figure 2: the paper's indirect method",
                "Beside it the default on the same sets.",
                "this paper",
                "default",
            ),
            poles(
                "Figure 3: the other indirect methods",
                "Windows p = f of 10 and of 20, as in the paper.",
                "Van Overschee-De Moor",
                "Oku-Tanaka",
            ),
            poles(
                "Figure 4: a direct and a simultaneous method",
                "SSARX with p = 30, f = 10; ORT with p = f = 20, whose observability matrix is Oku-Tanaka's.",
                "SSARX",
                "ORT",
            ),
            Section(
                title="Figure 5: response of the noise models",
                figures=(
                    Figure(
                        figure=noise_figure({name: models[name] for name in ("this paper", "default")}),
                        caption="Standard deviation of the innovations times the noise model's magnitude.",
                    ),
                ),
            ),
        ),
    )


def main() -> None:
    target = os.environ.get("FIGURES")
    if not target:
        print("figures 2 to 5 of Pouliquen et al. 2011: FIGURES=folder names where to draw them")
        return
    count = int(os.environ.get("SETS", "100"))
    models = estimates(count)
    Path(target).mkdir(parents=True, exist_ok=True)
    path = Path(target) / "closed_loop_figures.html"
    write_page(page(models, count), path)
    for title, found in models.items():
        print(f"{title:24s} {len(found)} models of {count} sets")
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
