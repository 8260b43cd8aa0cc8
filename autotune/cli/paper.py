"""Commands: the figures and tables of the papers, for one's own run or for the papers' examples."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from autotune.cli import app
from autotune.cli.common import OVERWRITE
from autotune.cli.plain_help import PlainGroup
from autotune.errors import InputError
from autotune.outputs import Output

if TYPE_CHECKING:
    from autotune.identification.closed_loop.state_space import InnovationModel
    from autotune.recording import Recording
    from autotune.report.relay_tables import Law

paper = typer.Typer(cls=PlainGroup, help="Draw the figures and tables of the papers.", no_args_is_help=True)
app.add_typer(paper, name="paper")

#: Title, method and window of figures 2 to 5.
_DRAWN: dict[str, tuple[Any, int]] = {
    "this paper": ("indirect", 15),
    "Van Overschee-De Moor": ("van-overschee", 10),
    "Oku-Tanaka": ("oku-tanaka", 20),
    "SSARX": ("ssarx", 30),
    "ORT": ("ort", 20),
    "default": ("prediction-error", 0),
}

_NOISE_GAIN = Annotated[
    float | None,
    typer.Option(
        min=1e-9,
        help="N_max of the design and of (26) [u/y unit]; when absent 0.1 of the paper's ball, "
        "else ten over the plant's gain where its phase is -135 degrees",
    ),
]


@paper.command("relay")
def relay(
    out: Annotated[Path, typer.Option(help="page to write (HTML)")],
    points: Annotated[
        Path | None, typer.Option(help="points (JSON): result.json of a run, or of identify frequency")
    ] = None,
    plant: Annotated[
        Path | None, typer.Option(help="model file (TOML) of the plant, where it is known; fitted to the points else")
    ] = None,
    controller: Annotated[
        Path | None,
        typer.Option(help="controller file (TOML) or result.json; the PI designed on the reduced model when absent"),
    ] = None,
    beside: Annotated[list[Path] | None, typer.Option(help="a further controller file; may be repeated")] = None,
    noise_gain: _NOISE_GAIN = None,
    dominant: Annotated[
        float | None, typer.Option(min=1e-9, help="with --rest an RST too: its double dominant pole [rad/s]")
    ] = None,
    rest: Annotated[float | None, typer.Option(min=1e-9, help="its other poles [rad/s]")] = None,
    overwrite: OVERWRITE = False,
) -> None:
    """Tables I and II and figures 6 to 9 of Le & Mendes, for a run's points, a known plant, or the paper's ball.

    On the paper's ball (23) the tables have printed, recomputed and own values side by side.
    """
    from autotune.api.examples import BALL
    from autotune.api.methods import reduce, tune, validate
    from autotune.api.plants import as_plant
    from autotune.api.points import Points
    from autotune.api.pole_placement import rst
    from autotune.controller import read_controller
    from autotune.design.noise import LoopFacts, default_noise_gain
    from autotune.design.rst import comparison_rst
    from autotune.identification.parametric import fit_plant
    from autotune.points import read_points
    from autotune.report.page import write_page
    from autotune.report.relay_figures import relay_page
    from autotune.report.relay_tables import PAPER_NOISE_GAIN

    place = Output(out, inputs=(points, plant, controller, *(beside or [])), overwrite=overwrite)
    if (dominant is None) != (rest is None):
        raise InputError("an RST takes --dominant and --rest together", where="autotune paper relay")
    measured = Points([] if points is None else read_points(points))
    known = as_plant(plant) if plant is not None else fit_plant(measured).plant if measured else BALL
    of_paper = known == BALL
    if noise_gain is None:
        highest = measured[-1].omega_rad_s if measured else None
        noise_gain = PAPER_NOISE_GAIN if of_paper else default_noise_gain(known, LoopFacts(), highest)[0]
    reduced = reduce(measured if measured else known)
    laws: dict[str, Law] = {}
    if controller is None:
        plants = {"PI on the reduced model": reduced, **({"PI on (23)": known} if of_paper else {})}
        laws |= {name: tune(one, noise_gain=noise_gain, certificate=False).controller for name, one in plants.items()}
    else:
        laws[controller.stem] = read_controller(controller)
    first = next(iter(laws.values()))
    laws |= {path.stem: read_controller(path) for path in beside or []}
    if dominant is not None and rest is not None:
        laws["RST placed here"] = rst(known, dominant_rad_s=dominant, rest_rad_s=rest)
    compared = validate(known, reduced, first)
    named = "the plant fitted to the points" if plant is None and measured else "the plant"
    rebuilt = comparison_rst(known) if of_paper else None
    page = relay_page(measured, reduced, known, laws, compared, noise_gain, named, rebuilt)
    place.by(lambda part: write_page(page, part))
    typer.echo(f"{page.verdict} wrote {out}")


@paper.command("delay")
def delay(
    out: Annotated[Path, typer.Option(help="page to write (HTML)")],
    sets: Annotated[int, typer.Option(min=2, max=10_000, help="noisy recordings of each of the paper's examples")] = 40,
    overwrite: OVERWRITE = False,
) -> None:
    """Tables 1 and 2 and figures 1 to 3 of Ollivier et al.: printed, recomputed by the paper's way, and weighted."""
    from rich.progress import track

    from autotune.cli.paper_delay import followed_examples, one_delay_estimates, two_delay_estimates
    from autotune.report.delay_tables import delay_page
    from autotune.report.page import write_page

    place = Output(out, inputs=(), overwrite=overwrite)
    one = one_delay_estimates(track(range(sets), description="one delay", transient=True))
    two = two_delay_estimates(track(range(sets), description="two delays", transient=True))
    page = delay_page(one, two, followed_examples())
    place.by(lambda part: write_page(page, part))
    typer.echo(f"{page.verdict} wrote {out}")


@paper.command("closed-loop")
def closed_loop(
    out: Annotated[Path, typer.Option(help="page to write (HTML)")],
    sets: Annotated[
        int, typer.Option(min=1, max=10_000, help="data sets of 1229 samples of the paper's example")
    ] = 100,
    overwrite: OVERWRITE = False,
) -> None:
    """Figures 2 to 5 of Pouliquen et al.: poles by each method and the noise models, on the paper's example."""
    import numpy as np
    from rich.progress import track

    from autotune.api.examples import LOOP_NOISE, LOOP_PLANT, example
    from autotune.identification.closed_loop.confidence import pole_covariance
    from autotune.identification.closed_loop.prediction_error import prediction_error
    from autotune.identification.closed_loop.state_space import from_polynomials
    from autotune.report.loop_figures import loop_page
    from autotune.report.page import write_page

    place = Output(out, inputs=(), overwrite=overwrite)
    models: dict[str, list[InnovationModel]] = {title: [] for title in _DRAWN}
    truth = from_polynomials(*LOOP_PLANT, LOOP_NOISE, variance=1.0 / 9.0)
    squares = []
    for seed in track(range(sets), description="data sets", transient=True):
        data = example("loop", seed=seed)
        _estimate(data, models)
        at_truth = prediction_error(truth, data.u[:, None], data.y[:, None], offset=False, max_iterations=0)
        of_poles = np.trace(pole_covariance(at_truth), axis1=1, axis2=2)[truth.poles.imag >= 0.0]
        squares.append(of_poles * (1.0 - at_truth.parameters / at_truth.rows))
    bound = np.sqrt(np.mean(squares, axis=0))
    place.by(lambda part: write_page(loop_page(models, truth, sets, bound), part))
    found = ", ".join(f"{title} {len(every)}" for title, every in models.items())
    typer.echo(f"models of {sets} sets: {found}; wrote {out}")


def _estimate(data: Recording, models: dict[str, list[InnovationModel]]) -> None:
    """Add every method's model of one data set; a method without a model of it is left out."""
    import contextlib

    from autotune.api.examples import LOOP_CONTROLLER
    from autotune.controller import DiscreteController
    from autotune.errors import IdentificationError
    from autotune.identification.closed_loop.methods import NEED_R, Windows, closed_loop_model, markov_of

    law = DiscreteController(num=LOOP_CONTROLLER[0], den=LOOP_CONTROLLER[1], sample_time_s=1.0)
    for title, (method, window) in _DRAWN.items():
        with contextlib.suppress(IdentificationError):
            models[title].append(
                closed_loop_model(
                    data.u[:, None],
                    data.y[:, None],
                    method=method,
                    order=5,
                    r=data.extra["r"][:, None],
                    controller_markov=markov_of(law, 40),
                    windows=Windows(f=window) if method in NEED_R else Windows(p=window or None),
                )
            )
