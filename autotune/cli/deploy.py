"""Commands: gains into a rig's own controller with verification, and the verification of the gains that it holds."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import typer
from rich.console import Console

from autotune.cli import app
from autotune.cli.common import CONFIG, U_SPAN, Y_SPAN, ProgressBar, rig_of
from autotune.controller_forms import FORMS
from autotune.errors import AutotuneError, ExperimentStopped, InputError
from autotune.outputs import OutputFolder
from autotune.whole_files import jsonable, write_json

if TYPE_CHECKING:
    from rich.table import Table

    from autotune.config import Config
    from autotune.controller import PIDController
    from autotune.experiment.judgement import Verification
    from autotune.experiment.rig import HoldsGains, Rig, TrialGains
    from autotune.identification.parametric import PlantFit
    from autotune.pipeline.audit import AuditLog
    from autotune.pipeline.folder import Measured
    from autotune.report.page import Page

    Form: TypeAlias = str
else:
    Form = Literal[tuple(FORMS)]

_CONTROLLER = Annotated[Path | None, typer.Option(metavar="C.toml", help="controller file with the gains")]
_RUN = Annotated[
    Path | None, typer.Option(metavar="DIR", help="folder of a run: its points predict the loop, its files go there")
]
_POINTS = Annotated[
    Path | None, typer.Option(metavar="P.json", help="points that predict the loop, instead of a run's")
]
_OUT = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="folder for journal, recording and page; default: the run's, or NAME-gains"),
]
_FORM = Annotated[Form, typer.Option(help="form that the gains are shown in, as the controller's maker calls them")]


@app.command()
def deploy(
    config: CONFIG,
    controller: _CONTROLLER = None,
    design: Annotated[Path | None, typer.Option(metavar="design.json", help="design with the gains")] = None,
    run: _RUN = None,
    points: _POINTS = None,
    out: _OUT = None,
    form: _FORM = "isa",
    u_span: U_SPAN = 1.0,
    y_span: Y_SPAN = 1.0,
    verify: Annotated[bool, typer.Option(help="try the new gains on the rig and take them back if they fail")] = True,
    yes: Annotated[bool, typer.Option("--yes", help="do not ask")] = False,
    approved_by: Annotated[
        str | None, typer.Option(metavar="NAME", help="second person who approves, where [approval] asks for one")
    ] = None,
    reason: Annotated[str | None, typer.Option(metavar="TEXT", help="why that person approves")] = None,
) -> None:
    """Try gains in the rig's own controller, and write them for good where the loop behaves as predicted."""
    from autotune.config import load_config
    from autotune.pipeline.approval import approval_of
    from autotune.pipeline.audit import audit_log
    from autotune.pipeline.deployment import deploy as hand_over
    from autotune.pipeline.folder import JOURNAL
    from autotune.pipeline.held_gains import round_to_rig
    from autotune.pipeline.result import deployment_json
    from autotune.pipeline.sensible_gains import require_sensible
    from autotune.report.run_page import deployment_page

    content = load_config(config)
    approval = approval_of(content, approved_by, reason)
    new = _gains(controller, design, run)
    known = _plant(run, points) if verify or run is not None or points is not None else None
    fit = None if known is None else known[1]
    rig = _with_gains(rig_of(content))
    new = round_to_rig(rig, new, content.design, fit=fit)
    if not yes and not sys.stdin.isatty():
        raise InputError(
            "nobody can be asked here", where="autotune deploy", remedy="look at the gains, then give --yes"
        )
    folder = _folder(config, run, out)
    console = Console(highlight=False, soft_wrap=True)
    audit = audit_log(content, folder, "deploy", asdict(approval) if approval is not None else None)
    _restore_interrupted(rig, folder / JOURNAL, console, yes, audit)

    def agree(old: PIDController, to_be: PIDController) -> None:
        require_sensible(content, old, to_be, fit)
        console.print(_comparison(content, old, to_be, form, (u_span, y_span), fit))
        if not yes and not typer.confirm("Write the new gains?"):
            raise InputError("refused: nothing was written", where="autotune deploy")
        folder.mkdir(parents=True, exist_ok=True)  # not before: what is refused leaves no folder

    def try_out(held: PIDController, gains: TrialGains | None) -> Verification:
        assert known is not None
        return _verify(rig, content, held, known, folder, gains=gains)

    done = hand_over(rig, new, folder / JOURNAL, agree=agree, try_out=try_out if verify else None, audit=audit)
    said = deployment_json(done)
    _report(folder / "deploy.json", said, lambda: deployment_page(content.name, content.signals, done))
    if not done.kept:
        raise typer.Exit(ExperimentStopped.exit_status)


@app.command()
def verify(
    config: CONFIG, run: _RUN = None, points: _POINTS = None, controller: _CONTROLLER = None, out: _OUT = None
) -> None:
    """Try the gains that the rig's own controller holds (or a file's) on the rig, against what its points predict."""
    from autotune.config import load_config
    from autotune.experiment.rig import HoldsGains
    from autotune.pipeline.deployment import read_gains
    from autotune.pipeline.result import verification_json
    from autotune.report.run_page import verification_page

    content = load_config(config)
    known = _plant(run, points)
    rig = rig_of(content)
    own = isinstance(rig, HoldsGains) and controller is None
    gains = read_gains(rig) if isinstance(rig, HoldsGains) and own else _gains(controller, None, run)
    folder = _folder(config, run, out)
    folder.mkdir(parents=True, exist_ok=True)
    verification = _verify(rig, content, gains, known, folder, on_device=own)
    said = {"controller": asdict(gains), "verification": verification_json(verification)}
    _report(folder / "verify.json", said, lambda: verification_page(content.name, content.signals, gains, verification))
    if not verification.accepted:
        raise typer.Exit(ExperimentStopped.exit_status)


def _report(place: Path, said: Mapping[str, Any], draw: Callable[[], Page]) -> None:
    """Write what was found and its page, beside those of earlier calls, and say the verdict."""
    from autotune.pipeline.folder import next_free
    from autotune.report.page import write_page

    result = next_free(place, ".html")
    write_json(result, jsonable(said))
    page = draw()  # not before: the figures are kept whatever becomes of the page
    write_page(page, result.with_suffix(".html"))
    console = Console(highlight=False, soft_wrap=True)
    console.print(page.verdict, markup=False)
    console.print(f"report: {result.with_suffix('.html')}", markup=False)


def _gains(controller: Path | None, design: Path | None, run: Path | None) -> PIDController:
    """Return the gains of the one source that was given."""
    from autotune.controller import PIDController, read_controller, read_designed
    from autotune.pipeline.folder import RESULT

    if controller is not None and design is not None:
        raise InputError("both --controller and --design", where="gains", remedy="give one of them")
    if controller is not None:
        given = read_controller(controller)
        if not isinstance(given, PIDController):
            raise InputError("no PI or PID", where=str(controller), remedy="a rig's own controller takes K, Ti, Td")
        return given
    if design is not None:
        return read_designed(design)
    if run is not None:
        return read_designed(run / RESULT)
    raise InputError("no gains", where="gains", remedy="give --controller, --design or --run")


def _plant(run: Path | None, points: Path | None) -> tuple[Measured, PlantFit]:
    """Return what is known of the rig, and the plant that its loop is predicted with."""
    from autotune.identification.frequency.recorded import session_points
    from autotune.identification.parametric import fit_plant
    from autotune.pipeline.folder import Measured, read_measured, recordings
    from autotune.points import read_points
    from autotune.recording import read_recording

    if points is not None:
        measured = Measured(points=read_points(points))
    elif run is not None:
        measured = read_measured(run)
        if any(point.source == "sweep" for point in measured.points):  # they share their errors: the rows' own plant
            fit = session_points([read_recording(path) for path in recordings(run)]).fit
            if fit is not None:
                return measured, fit
    else:
        raise InputError(
            "there is nothing to predict the loop with",
            where="verification",
            remedy="give --run DIR or --points P.json (deploy without it: --no-verify)",
        )
    return measured, fit_plant(measured.points)


def _with_gains(rig: Rig) -> HoldsGains:
    from autotune.experiment.rig import HoldsGains

    if not isinstance(rig, HoldsGains):
        raise InputError(
            "the gains of the rig's own controller cannot be reached",
            where="rig",
            remedy="map rig.registers.K and Ti; or enter the gains by hand and run autotune verify --controller C.toml",
        )
    return rig


def _folder(config: Path, run: Path | None, out: Path | None) -> Path:
    """Return the folder of the journal: the same for every call with the same arguments, so that it is found again."""
    return OutputFolder(out or run or config.with_name(f"{config.stem}-gains"), ()).path


def _restore_interrupted(rig: HoldsGains, journal: Path, console: Console, yes: bool, audit: AuditLog) -> None:
    """Offer to write the old gains back where an earlier hand-over did not come to its end."""
    from autotune.pipeline.deployment import restore
    from autotune.pipeline.journal import Journal

    old = Journal(journal).unfinished()
    if old is None:
        return
    console.print(
        f"An earlier hand-over was interrupted ({journal}): the rig may hold gains that were never verified, or mixed"
        f" ones. Before it, it held K = {old.K:.6g}, Ti = {old.Ti_s:.6g} s.",
        markup=False,
    )
    if not yes and not typer.confirm("Restore those first?", default=True):
        raise InputError(
            "refused: nothing was written",
            where=str(journal),
            remedy="move the journal away if the gains are right now",
        )
    restore(rig, old, journal, audit=audit, why="an earlier hand-over was interrupted")
    console.print("The old gains are in place again.")


def _verify(
    rig: Rig, config: Config, controller: PIDController, known: tuple[Measured, PlantFit], folder: Path, *,
    on_device: bool = False, gains: TrialGains | None = None,
) -> Verification:  # fmt: skip
    from autotune.experiment.verify import run_verification
    from autotune.pipeline.folder import VERIFICATION, next_free

    measured, fit = known
    with ProgressBar() as bar:
        return run_verification(
            rig, config, controller, fit, next_free(folder / VERIFICATION, ".toml"),
            u_rest=measured.u_rest, noise_sd=measured.noise_sd, on_device=on_device, gains=gains, on_status=bar.show,
        )  # fmt: skip


def _comparison(
    config: Config,
    old: PIDController,
    new: PIDController,
    form: Form,
    spans: tuple[float, float],
    fit: PlantFit | None,
) -> Table:
    """Return old and new gains side by side, in the maker's form, with what the measured plant says of both."""
    from rich.markup import escape
    from rich.table import Table

    from autotune.controller_forms import to_form
    from autotune.design.margins import margins

    def shown(controller: PIDController) -> dict[str, str]:
        try:
            settings = to_form(
                controller, form, u_span=spans[0], y_span=spans[1], sample_time_s=config.signals.sample_time_s
            )
        except (AutotuneError, ZeroDivisionError):  # a device as delivered may hold what the form cannot say
            return {"K": f"{controller.K:.6g}", "Ti_s": f"{controller.Ti_s:.6g}"}
        rows = {name: f"{value:.6g}" for name, value in settings.values.items()}
        if fit is not None:
            m = margins(fit.plant, controller)
            rows |= {"modulus margin": f"{m.modulus:.3f}", "crossover [rad/s]": f"{m.crossover_rad_s:.3g}"}
            rows |= {"stable on the measured plant": "yes" if m.stable else "no"}
        return rows

    before, after = shown(old), shown(new)
    table = Table(form, "the rig holds", "new", title=escape(config.name))
    for name in dict.fromkeys((*before, *after)):
        table.add_row(escape(name), before.get(name, "-"), after.get(name, "-"))
    return table
