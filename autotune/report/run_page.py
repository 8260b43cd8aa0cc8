"""The page of a run: recording, limit cycles, Bode points, reduced model, margins, and the loop measured on the rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from autotune.config.procedure import SignalSettings
from autotune.controller import PIDController
from autotune.experiment.judgement import Verification
from autotune.experiment.leaving import sentence
from autotune.pipeline import Tuning
from autotune.pipeline.deployment import Deployment
from autotune.recording import Recording
from autotune.report.analysis_sections import analysis_sections, warnings_sections
from autotune.report.analysis_words import designed_text, gains_text, margins_sentence
from autotune.report.experiment_section import experiment_section
from autotune.report.figures import ratio_title, recording_figure
from autotune.report.outlook import outlook_section, outlook_sentences
from autotune.report.page import Figure, Page, Section, Table
from autotune.report.verification_section import verification_section

if TYPE_CHECKING:  # the diagnosis takes long to import, and few runs ask for one
    from autotune.diagnosis.result import Diagnosis


def run_page(
    name: str,
    signals: SignalSettings,
    recordings: Sequence[Recording],
    tuning: Tuning,
    diagnosis: Diagnosis | None = None,
) -> Page:
    """Return the page of a whole run on a rig.

    Parameters
    ----------
    name : str
        Of the rig, from the configuration.
    signals : SignalSettings
        Units.
    recordings : sequence of Recording
        The sweep's, one for each sitting at the rig.
    tuning : Tuning
        What the run ended with.
    diagnosis : Diagnosis, optional
        What the fitted plant leaves out; its own page is in ``diagnosis/report.html`` beside this one.
    """
    experiment, verification = tuning.experiment, tuning.verification
    simulated = verification is not None and verification.by == "simulation"
    sections = []
    if verification is not None:
        tried = verification_section(verification, signals)
        told = outlook_sentences(tuning.analysis, tuning.old_controller)
        sections.append(replace(tried, text=(*tried.text, *told)))
    if diagnosis is not None:
        sections.append(_diagnosis_section(diagnosis))
    if verification is None:
        sections += outlook_section(tuning.analysis, signals, tuning.old_controller)
    sections += reversed(analysis_sections(tuning.analysis, signals, experiment))
    sections.append(experiment_section(recordings, experiment, signals))
    sections += warnings_sections((*experiment.warnings, *tuning.analysis.warnings))
    verdict, good = _verdict(tuning, signals, simulated)
    return Page(
        title=f"{'Simulated commissioning' if simulated else 'Commissioning'}: {name}",
        verdict=verdict,
        tone="good" if good else "bad" if verification is not None else "warn",
        answers=_answers(tuning, signals, diagnosis),
        sections=tuple(sections),
    )


def stopped_run_page(name: str, signals: SignalSettings, recordings: Sequence[Recording], line: str) -> Page:
    """Return the page of a run that a limit, a fault or the operator stopped: why, and how the rig was left.

    Parameters
    ----------
    name : str
        Of the rig.
    signals : SignalSettings
        Units.
    recordings : sequence of Recording
        What was recorded, the last one last.
    line : str
        The one line that the run ended with.
    """
    figures = tuple(
        Figure(figure=recording_figure(recording, signals.u_unit, signals.y_unit), caption=recording.name)
        for recording in recordings
    )
    output = recordings[-1].metadata.get("ended", {}).get("output", "") if recordings else None
    left = f"When it was left: {sentence(output)}." if output is not None else "Nothing was recorded."
    return Page(
        title=f"Stopped: {name}",
        verdict=f"Stopped: {line}",
        tone="bad",
        summary=(left, "Nothing that was measured is lost: autotune run --resume goes on with what is missing."),
        sections=(Section(title="What was recorded", figures=figures),) if figures else (),
    )


def deployment_page(name: str, signals: SignalSettings, done: Deployment) -> Page:
    """Return the page of a hand-over of gains.

    Parameters
    ----------
    name : str
        Of the rig.
    signals : SignalSettings
        Units.
    done : Deployment
        Old and new gains, and how the loop behaved with the new ones.
    """
    new, verification = gains_text(done.new, signals), done.verification
    if verification is None:
        verdict = f"Written and read back: {new}; not verified."
    elif done.kept:
        word = "Kept" if verification.by == "device" else "Written and read back"
        verdict = f"{word}: {new}; {verification.reason}; {verification.whose}."
    else:
        verdict = f"Not kept: {new}; {verification.reason}. The old gains are in place."
    gains = Table(
        header=(
            "",
            ratio_title("K", signals.u_unit, signals.y_unit),
            "T_I [s]",
            "T_d [s]",
            "T_f [s]",
            "now",
        ),
        rows=tuple(
            (label, *(f"{value:.5g}" for value in (c.K, c.Ti_s, c.Td_s, c.Tf_s)), "in the rig" if held else "")
            for label, c, held in (("old", done.old, not done.kept), ("new", done.new, done.kept))
        ),
    )
    return Page(
        title=f"Gains handed over: {name}",
        verdict=verdict,
        tone=_tone(verification),
        answers=(("What to do", _next_step(verification)),),
        sections=(
            Section(title="Gains", tables=(gains,)),
            *((verification_section(verification, signals),) if verification is not None else ()),
        ),
    )


def verification_page(
    name: str, signals: SignalSettings, controller: PIDController, verification: Verification
) -> Page:
    """Return the page of a verification on its own.

    Parameters
    ----------
    name : str
        Of the rig.
    signals : SignalSettings
        Units.
    controller : PIDController
        Gains that were tried.
    verification : Verification
        How the loop behaved.
    """
    said = "Accepted" if verification.accepted else "Not accepted"
    return Page(
        title=f"Verification: {name}",
        verdict=f"{said}: {gains_text(controller, signals)}; {verification.reason}; {verification.whose}.",
        tone=_tone(verification),
        answers=(("What to do", _next_step(verification)),),
        sections=(verification_section(verification, signals),),
    )


def _tone(verification: Verification | None) -> Literal["good", "warn", "bad"]:
    """Return the tone of a page: good only where what was verified is what will run."""
    if verification is None or (verification.accepted and verification.untried):
        return "warn"
    return "good" if verification.accepted else "bad"


def _next_step(verification: Verification | None) -> str:
    if verification is None:
        return "Verify the controller on the rig."
    if verification.accepted and verification.untried:
        return (
            "Put the device's own controller in automatic, stand beside it, and step its set-point: only the host's law"
            f" was verified ({verification.untried})."
        )
    if verification.accepted and verification.by == "simulation":
        return "Run it on the rig: a simulation shows what its model does, and nothing that the model leaves out."
    if verification.accepted:
        return "Watch the loop through its usual operating range; the points were measured at one of them."
    return (
        "Compare prediction and measurement below; diagnose the recording against the fitted model to find"
        " which physics was left out."
    )


def _verdict(tuning: Tuning, signals: SignalSettings, simulated: bool) -> tuple[str, bool]:
    gains = designed_text(tuning.analysis.design, signals)
    if tuning.verification is None:
        return f"{gains}: designed, not verified.", False
    if tuning.verification.accepted:
        held = "the rig holds its old gains" if tuning.old_controller else "its gains are in result.json"
        where = "the rig holds it now" if tuning.deployed else held
        where = "no real one was touched" if simulated else where
        return f"Accepted: {gains}; {tuning.verification.reason}; {tuning.verification.whose}; {where}.", True
    return f"Not accepted: {gains}; {tuning.verification.reason}. The old gains were kept.", False


def _answers(tuning: Tuning, signals: SignalSettings, diagnosis: Diagnosis | None) -> tuple[tuple[str, str], ...]:
    experiment, old = tuning.experiment, tuning.old_controller
    found = (
        f"{len(experiment.points)} points of the Bode diagram in {experiment.sweep_time_s:.0f} s of oscillation"
        f" ({experiment.rig_time_s:.0f} s on the rig in all)."
    )
    if old is not None:
        new, before = designed_text(tuning.analysis.design, signals), gains_text(old, signals)
        found += f" Before: {before}. Now: {new}." if tuning.deployed else f" The rig holds {before}; designed: {new}."
    sure = margins_sentence(tuning.analysis, signals)
    if tuning.verification is not None:
        sure += " The loop was tried: below, measured beside what was predicted."
    todo = (
        _next_step(tuning.verification)
        if diagnosis is None or diagnosis.verdict == "none"
        else "Read below why the loop differs from its prediction, and correct that or the model."
    )
    return ("Found", found), ("How sure", sure), ("What to do", todo)


def _diagnosis_section(found: Diagnosis) -> Section:
    following = found.next_experiment
    text = [*found.sentences]
    if found.places:
        text.append(f"It sits in: {', '.join(found.places)}.")
    if following is not None:
        text.append(f"Next experiment, to {following.purpose}: {following.kind}. Expected: {following.expected}.")
    effects = Table(
        header=("effect", "probability", "parameters"),
        rows=tuple(
            (
                effect.name,
                f"{effect.probability:.2f}",
                ", ".join(f"{name} = {p.value:.4g} {p.unit}".rstrip() for name, p in effect.parameters.items()),
            )
            for effect in found.effects
        ),
    )
    return Section(
        title="What the fitted plant leaves out",
        text=tuple(text),
        links=(("The whole diagnosis, with its pictures", "diagnosis/report.html"),),
        tables=(effects,) if found.effects else (),
    )
