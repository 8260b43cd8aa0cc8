"""Figures 2 to 5 of Pouliquen et al. 2011: estimated poles by each method, and the noise model's response.

The paper draws other data: the clouds are to be compared, not their points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.report import chart as go
from autotune.report.chart import make_subplots
from autotune.report.page import BLUE, GREY, ORANGE, Figure, Page, Section, Table, add_line

#: Frequencies of the noise model's response [rad/sample].
OMEGA = np.geomspace(0.01, np.pi, 300)

#: Mean of the estimated variances that the paper prints.
_VARIANCE = 0.1023

Models = Mapping[str, Sequence[InnovationModel]]


def _poles_figure(models: Models, truth: InnovationModel) -> Any:
    """Draw the poles of each method's models in the upper half of the z plane, the true ones on top."""
    figure = make_subplots(
        rows=1, cols=len(models), subplot_titles=[f"{name}: {len(found)} models" for name, found in models.items()]
    )
    circle = np.exp(1j * np.linspace(0.0, np.pi, 400))
    for col, found in enumerate(models.values(), start=1):
        poles = np.concatenate([model.poles for model in found])
        upper = poles[poles.imag >= 0.0]
        place: dict[str, Any] = {"row": 1, "col": col, "showlegend": col == 1}
        add_line(figure, circle.real, circle.imag, "unit circle", GREY, width=1.0, **place)
        _marks(figure, upper, "estimated", BLUE, "asterisk-open", 6, place)
        _marks(figure, truth.poles[truth.poles.imag >= 0.0], "plant", ORANGE, "cross-thin-open", 14, place)
        figure.update_xaxes(title="real part", row=1, col=col)
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


def _noise_figure(models: Models, truth: InnovationModel) -> Any:
    """Draw sigma times the magnitude of H for each method's models, the true one on top."""
    figure = make_subplots(rows=1, cols=len(models), subplot_titles=list(models))
    for col, found in enumerate(models.values(), start=1):
        # one trace for all sets, NaN between them, keeps the page small
        x = np.concatenate([np.append(OMEGA, np.nan) for _ in found])
        y = np.concatenate([np.append(_spectrum(model), np.nan) for model in found])
        place: dict[str, Any] = {"row": 1, "col": col, "showlegend": col == 1}
        add_line(figure, x, y, "estimated", BLUE, width=0.6, opacity=0.5, **place)
        add_line(figure, OMEGA, _spectrum(truth), "true", ORANGE, width=2.0, **place)
        figure.update_xaxes(title="frequency [rad/sample]", row=1, col=col)
    figure.update_xaxes(type="log")
    figure.update_yaxes(type="log", range=[-1.5, 2.5])
    figure.update_yaxes(title="σ |H|", col=1)
    return figure


def _spectrum(model: InnovationModel) -> FloatArray:
    sd = float(model.innovation_covariance[0, 0]) ** 0.5
    return np.asarray(sd * np.abs(model.noise_response(OMEGA)[:, 0, 0]), dtype=np.float64)


def _table(models: Models, truth: InnovationModel, bound: FloatArray) -> Table:
    """Return root mean square errors of the poles and mean variances, the paper's one printed number beside them."""
    targets = truth.poles[truth.poles.imag >= 0.0]
    rows = []
    for title, found in models.items():
        errors = np.array([[np.min(np.abs(model.poles - pole)) for pole in targets] for model in found])
        variances = [float(model.innovation_covariance[0, 0]) for model in found]
        rms = [f"{value:.4f}" for value in np.sqrt(np.mean(errors**2, axis=0))] if found else [""] * targets.size
        printed = f"{_VARIANCE:g}" if title == "this paper" else ""
        mean = f"{np.mean(variances):.4f}" if any(variances) else ""  # some methods have no noise model
        rows.append((title, str(len(found)), *rms, printed, mean))
    rows.append(("Cramer-Rao bound", "", *(f"{value:.4f}" for value in bound), "", ""))
    poles = (f"{pole.real:.4f}" + (f" + {pole.imag:.4f}i" if pole.imag else "") for pole in targets)
    return Table(
        header=("method", "models", *(f"rms error at {pole}" for pole in poles), "variance, printed", "variance, here"),
        rows=tuple(rows),
        caption="Mean of the innovations' variance, true value 0.1111; the printed mean is not reached by the printed"
        " formula. The paper prints no errors of the poles.",
    )


def loop_page(models: Models, truth: InnovationModel, count: int, bound: FloatArray) -> Page:
    """Return the page with the table and the figures.

    Parameters
    ----------
    models : mapping of str to sequence of InnovationModel
        Under ``this paper``, ``default``, ``Van Overschee-De Moor``, ``Oku-Tanaka``, ``SSARX`` and ``ORT``: the models
        that each method made of the data sets.
    truth : InnovationModel
        The plant that made them.
    count : int
        Number of data sets.
    bound : (P,) array
        Cramer-Rao bound of the poles in the upper half plane.
    """

    def poles(title: str, caption: str, *names: str) -> Section:
        figure = _poles_figure({name: models[name] for name in names}, truth)
        return Section(title=title, figures=(Figure(figure=figure, caption=caption, height_px=460),))

    noise = _noise_figure({name: models[name] for name in ("this paper", "default")}, truth)
    caption = "Standard deviation of the innovations times the noise model's magnitude."
    return Page(
        title="Pouliquen et al. 2011, closed-loop subspace identification: figures 2 to 5",
        verdict=f"{count} data sets of 1229 samples: the paper's method, four others, this tool's default.",
        tone="good",
        summary=("The lower half of the z plane is its mirror image.",),
        sections=(
            Section(title="Errors of the poles and the variance", tables=(_table(models, truth, bound),)),
            poles(
                "Figure 2: the indirect method",
                "Beside it this tool's default, a prediction error method, on the same sets.",
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
            Section(title="Figure 5: the noise models", figures=(Figure(figure=noise, caption=caption),)),
        ),
    )
