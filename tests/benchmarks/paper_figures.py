"""Figures 7 to 9 of Le & Mendes 2010: PI on the reduced model, RST and PI straight on the points, side by side.

``FIGURES=folder python -m tests.benchmarks paper_figures`` prints the table and writes ``folder/paper_figures.html``.
Both designs rest on one relay experiment on the simulated ball; the RST is placed on (23), which nobody has on a rig.
Every law runs sampled at 10 ms, in the loop that runs on hardware: on (23) alone without noise, and on the full rig
(tube, 12-bit converters, limits, +-0.35 V of noise, unknown hover voltage) with ``RIGS`` draws, 10 by default.
Responses are judged by the true height of the ball, which the noise moves too, and not by the reading.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from autotune.arrays import FloatArray
from autotune.config import Config, load_config
from autotune.controller import Controller, DiscreteController, PIDController
from autotune.design.law import PILaw
from autotune.design.margins import Margins, margins
from autotune.design.reference import flat_transition
from autotune.design.robust import design_on_points
from autotune.design.rst import comparison_rst
from autotune.design.rst_law import RSTLaw
from autotune.design.specification import spec1
from autotune.design.synthesis import design
from autotune.experiment.limits import Envelope, Watch
from autotune.experiment.loop import ControlLoop
from autotune.experiment.run import run_experiment
from autotune.identification.parametric import fit_plant
from autotune.identification.reduction import reduce_points
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint
from autotune.recording import RecordingWriter
from autotune.report.chart import make_subplots
from autotune.report.figures import Curve
from autotune.report.loop_diagrams import nichols_figure, sensitivity_figure
from autotune.report.page import BLUE, GREEN, GREY, ORANGE, PURPLE, Figure, Page, Section, Table, add_line, write_page
from drivers.simulated import SimulatedRig
from sim.ball import linear_ball, make_ball
from tests.autotune.design.plants import BALL

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "ball_sim.toml"
#: regulation before the steps, the set-point step and the load step [s]
SETTLE_S, STEP_S, LOAD_S = 20.0, 25.0, 25.0
#: set-point step [y unit] and load step [u unit]; both move the ball by about a volt
STEP, LOAD = 1.0, 0.04
REST = 5.0
SEEN = "Set-point step at 0 s, load step at 25 s; above the true height of the ball, below u with the load added to it."
OMEGA = np.geomspace(0.05, 100.0, 1200)


class Law(Protocol):
    """What a sampled control law offers."""

    def initial(self, u: float, r: float, y: float, /) -> Any:
        """Return the state that continues from u at rest."""
        ...

    def step(self, state: Any, r: float, y: float) -> tuple[float, Any]:
        """Return the command and the next state."""
        ...

    def discrete(self) -> DiscreteController:
        """Return the feedback without the hold."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Contender:
    """A law under comparison, with the set-point it is given and the command that comes with it."""

    name: str
    controller: Controller
    law: Law
    colour: str
    setpoint: FloatArray
    feedforward: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """Departure of the true height from rest and of the command from hover, after the settling."""

    y: FloatArray
    u: FloatArray


@dataclass(frozen=True, kw_only=True)
class Figures:
    """What is read off a run.

    Overshoot [%], rise to 90 % and settling to 10 % [s] of the set-point step, root of its error's ISE per step
    [s^(1/2)] and largest departure of u [u unit]; peak per load and root of the disturbance's ISE per load: (11) over
    25 s.
    """

    overshoot: float
    rise_s: float
    settling_s: float
    tracking: float
    command: float
    peak: float
    h2: float


def _open_loop(plant: TransferFunction, controller: Controller) -> TransferFunction:
    part = controller.transfer_function() if isinstance(controller, PIDController) else controller
    assert isinstance(part, TransferFunction)
    return plant * part


def contenders(config: Config, points: Sequence[FrequencyPoint]) -> tuple[Contender, ...]:
    """Return the paper's PI, the PI on the reduced model, the RST and the PI straight on the points."""
    T_s = config.signals.sample_time_s
    limits = {"u_min": config.limits.u_min, "u_max": config.limits.u_max}
    reduced = design(reduce_points(points).transfer_function(), spec1(0.1), certificate=False).controller
    straight = design_on_points(points, spec1(0.1)).controller
    rst = comparison_rst(BALL)
    step = np.full(round((STEP_S + LOAD_S) / T_s), STEP)
    laws: tuple[tuple[str, Controller, Law, str], ...] = tuple(
        (name, pi, PILaw(controller=pi, sample_time_s=T_s, u_rate=config.limits.u_rate, **limits), colour)
        for name, pi, colour in (
            ("PI of the paper", PIDController(K=-0.023, Ti_s=3.0), GREY),
            ("PI, reduced model", reduced, BLUE),
            ("PI, on the points", straight, GREEN),
        )
    )
    rst_law = RSTLaw(controller=rst, sample_time_s=T_s, **limits)
    laws = (*laws[:2], ("RST of order 5", rst.feedback(), rst_law, ORANGE), laws[2])
    return tuple(
        Contender(name=name, controller=c, law=law, colour=colour, setpoint=step, feedforward=0.0 * step)
        for name, c, law, colour in laws
    )


def two_degrees(config: Config, plain: Contender, plant: TransferFunction, command: float) -> tuple[Contender, ...]:
    """Return the PI with the step as it is, with the prefilter for two set-point weights, and with a flat trajectory.

    ``plant`` is what the flat trajectory is planned on and ``command`` the most it may ask for beside hover [u unit].
    """
    law = plain.law
    assert isinstance(law, PILaw)
    half, none = (replace(law, controller=replace(law.controller, setpoint_weight=b)) for b in (0.8, 0.0))
    T_s, count = config.signals.sample_time_s, plain.setpoint.size
    planned = flat_transition(plant, y_start=0.0, y_end=STEP, u_rest=0.0, u_min=-command, u_max=command)
    t = T_s * np.arange(count)
    # y follows u by the dead time; the held command is that of the middle of its sample
    r = np.interp(t - plant.delay_s, planned.t_s, planned.y)
    u = np.interp(t + 0.5 * T_s, planned.t_s, planned.u)
    return (
        replace(plain, name="step as it is", colour=GREY),
        replace(plain, name="prefilter, b = 0.8", law=half, colour=BLUE),
        replace(plain, name="prefilter, b = 0", law=none, colour=PURPLE),
        replace(plain, name="flat trajectory", setpoint=r, feedforward=u, colour=GREEN),
    )


def run(rig: SimulatedRig, envelope: Envelope, contender: Contender, folder: Path) -> Run:
    """Run the law on the rig, afloat at its operating point: settle, set-point step, load step."""
    T_s = envelope.sample_time_s
    settle = round(SETTLE_S / T_s)
    setpoint = REST + np.concatenate([np.zeros(settle), contender.setpoint])
    added = np.concatenate([np.zeros(settle), contender.feedforward])
    added[settle + round(STEP_S / T_s) :] += LOAD
    y, u = np.empty(setpoint.size), np.empty(setpoint.size)
    writer = RecordingWriter(folder / f"{len(list(folder.iterdir()))}.csv", ("t", "u", "y"))
    with ControlLoop(rig=rig, envelope=envelope, writer=writer) as loop:
        loop.watch = Watch(y_centre=REST, in_range=True)
        state = contender.law.initial(loop.tick.u, REST, REST)
        for k, r in enumerate(setpoint.tolist()):
            y[k] = rig.plant.y_true - REST
            u[k], state = contender.law.step(state, r, loop.tick.y)
            loop.step(loop.nearest(u[k] + float(added[k])))
    return Run(y=y[settle:], u=(u + added)[settle:] - rig.plant.u_rest)


def figures_of(contender: Contender, result: Run, T_s: float) -> Figures:
    """Read the figures off a run."""
    split = round(STEP_S / T_s)
    rising, loaded = result.y[:split] / STEP, result.y[split:] - STEP
    outside = np.flatnonzero(np.abs(rising - 1.0) > 0.1)
    return Figures(
        overshoot=100.0 * max(0.0, float(rising.max()) - 1.0),
        rise_s=float(np.argmax(rising >= 0.9)) * T_s if rising.max() >= 0.9 else math.nan,
        settling_s=float(outside[-1] + 1) * T_s if outside[-1] + 1 < split else math.nan,
        tracking=math.sqrt(T_s * float(np.sum((rising - 1.0) ** 2))),
        command=float(np.abs(result.u[:split]).max()),
        peak=float(np.abs(loaded).max()) / LOAD,
        h2=math.sqrt(T_s * float(np.sum(loaded**2))) / LOAD,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """A contender with its margins on (23) and its runs: on (23) alone first, then on the rigs."""

    contender: Contender
    continuous: Margins
    sampled: Margins
    linear: Run
    rigs: tuple[Run, ...]


def outcome(config: Config, contender: Contender, rigs: int, folder: Path) -> Outcome:
    """Run one contender on (23) alone and on the full rigs."""
    T_s = config.signals.sample_time_s
    free = config.limits.model_copy(update={"u_min": -100.0, "u_max": 100.0, "u_rate": 1e6})
    ideal = Envelope(settings=free, sample_time_s=T_s)
    real = Envelope(settings=config.limits, sample_time_s=T_s, u_step=config.signals.u_step)
    return Outcome(
        contender=contender,
        continuous=margins(BALL, contender.controller),
        sampled=margins(BALL, contender.law.discrete()),
        linear=run(SimulatedRig(linear_ball(), u_safe=REST), ideal, contender, folder),
        rigs=tuple(
            run(SimulatedRig(make_ball(seed=seed, noise=0.35, start="afloat"), u_safe=0.0), real, contender, folder)
            for seed in range(1, rigs + 1)
        ),
    )


MARGINS = ("controller", "K", "T_I [s]", "M_m", "phase [deg]", "M_ret [s]", "w_gc [rad/s]", "noise (15)", "H2 (11)")
RESPONSES = (
    "set-point step, then load step",
    "overshoot [%]",
    "rise 90 % [s]",
    "settling 10 % [s]",
    "root ISE/step",
    "max |u| [V]",
    "peak/load",
    "root ISE/load",
)


def margins_table(outcomes: Sequence[Outcome]) -> Table:
    """Margins of the continuous law on (23), with those of the sampled and held law after the slash."""
    rows = []
    for o in outcomes:
        c, m, d = o.contender.controller, o.continuous, o.sampled
        gains = (f"{c.K:.5f}", f"{c.Ti_s:.3f}") if isinstance(c, PIDController) else ("-", "-")
        pairs = (
            f"{m.modulus:.3f} / {d.modulus:.3f}",
            f"{math.degrees(m.phase_rad):.1f} / {math.degrees(d.phase_rad):.1f}",
            f"{m.delay_s:.3f} / {d.delay_s:.3f}",
        )
        norms = (f"{m.crossover_rad_s:.2f}", f"{m.noise_gain:.3f}", f"{m.h2:.2f} / {d.h2:.2f}")
        rows.append((o.contender.name, *gains, *pairs, *norms))
    return Table(header=MARGINS, rows=tuple(rows), caption="On (23): continuous / sampled at 10 ms and held.")


def responses_table(outcomes: Sequence[Outcome], T_s: float) -> Table:
    """Figures of the responses on (23) alone, and mean and standard deviation over the rigs."""
    rows = []
    for o in outcomes:
        alone = vars(figures_of(o.contender, o.linear, T_s)).values()
        rows.append((f"{o.contender.name}, (23)", *(f"{round(value, 4):.3g}" for value in alone)))
        drawn = np.array([list(vars(figures_of(o.contender, r, T_s)).values()) for r in o.rigs])
        cells = (f"{np.mean(d):.3g} ± {np.std(d, ddof=1):.1g}" for d in drawn.T)
        rows.append((f"{o.contender.name}, full rig", *cells))
    count = len(outcomes[0].rigs)
    caption = f"Set-point step {STEP:g} V, load step {LOAD:g} V; full rig: mean ± sd of {count}, noise included."
    return Table(header=RESPONSES, rows=tuple(rows), caption=caption)


def responses_figure(outcomes: Sequence[Outcome], T_s: float) -> Any:
    """Draw y over u, left on (23) alone, right on the first full rig."""
    figure = make_subplots(
        rows=2,
        cols=2,
        shared_xaxes=True,
        vertical_spacing=0.08,
        horizontal_spacing=0.07,
        row_heights=[0.6, 0.4],
    )
    thin = slice(None, None, 4)
    for o in outcomes:
        for col, result in ((1, o.linear), (2, o.rigs[0])):
            t, look = T_s * np.arange(result.y.size), (o.contender.name, o.contender.colour)
            add_line(figure, t[thin], result.y[thin], *look, row=1, col=col, showlegend=col == 1)
            add_line(figure, t[thin], result.u[thin], *look, row=2, col=col, showlegend=False, width=0.9)
    figure.update_yaxes(title="y - 5 V [V]", row=1, col=1)
    figure.update_yaxes(title="u - hover [V]", row=2, col=1)
    figure.update_yaxes(range=[-0.1, 0.08], row=2)
    figure.update_xaxes(title="time on the linear plant (23) [s]", row=2, col=1)
    figure.update_xaxes(title="time on the full rig [s]", row=2, col=2)
    return figure


def page(
    outcomes: Sequence[Outcome], degrees: Sequence[Outcome], reduced: TransferFunction, tables: Mapping[str, Table]
) -> Page:
    """Lay out figures 7, 8 and 9 and the comparison with two degrees of freedom."""
    on_reduced, rst, straight = outcomes[1:]
    c = on_reduced.contender.controller
    seven = [
        Curve(name="reduced model", system=_open_loop(reduced, c), colour=ORANGE, dash="dash"),
        Curve(name="plant (23)", system=_open_loop(BALL, c), colour=BLUE),
    ]
    eight = [
        Curve(name=o.contender.name, system=_open_loop(BALL, o.contender.controller), colour=o.contender.colour)
        for o in outcomes
    ]
    phase = math.radians(45.0)
    nichols = "Black-Nichols: the loop must stay outside the dotted curve and right of the bar at 0 dB."
    sensitivity = "Sensitivity: below the dotted line the modulus margin is at least 0.5."

    def robust(curves: list[Curve]) -> tuple[Figure, ...]:
        return (
            Figure(figure=nichols_figure(curves, OMEGA, 0.5, phase), caption=nichols),
            Figure(figure=sensitivity_figure(curves, OMEGA, 0.5), caption=sensitivity),
        )

    T_s = load_config(CONFIG).signals.sample_time_s
    nine, two = responses_figure(outcomes, T_s), responses_figure(degrees, T_s)
    won = 100.0 * (1.0 - straight.continuous.h2 / on_reduced.continuous.h2)
    return Page(
        title="Ball in a tube: PI on the reduced model, RST, PI straight on the points",
        verdict=f"Straight on the points the PI has H2 {straight.continuous.h2:.1f} on the true plant, {won:.0f} %"
        f" below the PI on the reduced model of the same points ({on_reduced.continuous.h2:.1f}); the RST, which needs"
        f" the full model, reaches {rst.continuous.h2:.1f}.",
        tone="good",
        summary=("Spec1: M_m 0.5, 45 degrees, N_max 0.1. Points of one relay experiment at ±0.35 V of noise.",),
        sections=(
            Section(title="Margins and responses", tables=(tables["margins"], tables["responses"])),
            Section(title="Figure 7: the PI on the reduced model and on the plant", figures=robust(seven)),
            Section(title="Figure 8: the controllers on the plant", figures=robust(eight)),
            Section(
                title="Figure 9: set-point step and load step",
                figures=(Figure(figure=nine, caption=SEEN, height_px=560),),
            ),
            Section(
                title="Two degrees of freedom: the PI on the points with and without a shaped set-point",
                text=(
                    "The feedback and so the load response are the same. The prefilter (b T_I s + 1)/(T_I s + 1) is the"
                    " PI with set-point weight b. With b = 0 the zero at -1/T_I, which nearly cancels the loop's slow"
                    " pole, is gone: no overshoot, and a slow response. The flat trajectory is planned on the plant"
                    " fitted to the points, with no more command than the plain step takes on (23).",
                ),
                tables=(tables["degrees"],),
                figures=(Figure(figure=two, caption=SEEN, height_px=560),),
            ),
        ),
    )


def _show(table: Table) -> None:
    widths = [max(len(row[i]) for row in (table.header, *table.rows)) + 2 for i in range(len(table.header))]
    print(table.caption)
    for row in (table.header, *table.rows):
        print(
            "  " + row[0].ljust(widths[0]) + "".join(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True))
        )


def main() -> None:
    config, rigs = load_config(CONFIG), int(os.environ.get("RIGS", "10"))
    T_s = config.signals.sample_time_s
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ball = SimulatedRig(make_ball(seed=1, noise=0.35), u_safe=0.0)
        points = run_experiment(ball, config, folder / "experiment.csv").points
        outcomes = [outcome(config, contender, rigs, folder) for contender in contenders(config, points)]
        straight = outcomes[-1]
        command = figures_of(straight.contender, straight.linear, T_s).command
        fitted = fit_plant(points).plant
        shaped = two_degrees(config, straight.contender, fitted, command)
        degrees = [replace(straight, contender=shaped[0])]
        degrees += [outcome(config, contender, rigs, folder) for contender in shaped[1:]]
    tables = {
        "margins": margins_table(outcomes),
        "responses": responses_table(outcomes, T_s),
        "degrees": responses_table(degrees, T_s),
    }
    for table in tables.values():
        _show(table)
    target = os.environ.get("FIGURES")
    if target:
        Path(target).mkdir(parents=True, exist_ok=True)
        path = Path(target) / "paper_figures.html"
        write_page(page(outcomes, degrees, reduce_points(points).transfer_function(), tables), path)
        print(f"wrote {path}")


if __name__ == "__main__":
    main()
