"""From frequency points or a fitted plant to a checked controller, without a rig: fit, reduce, design, check."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, TypeVar

import numpy as np

from autotune.config.procedure import DesignSettings
from autotune.controller import PIDController
from autotune.design.checks import Check, checks, on_plants
from autotune.design.margins import Margins, margins
from autotune.design.noise import LoopFacts, default_noise_gain
from autotune.design.nugap import Validation, loop_scaling, validate
from autotune.design.on_fit import CONTRADICTED, design_on_fit, worst_of
from autotune.design.on_reduced import design_on_reduced
from autotune.design.plausibility import implausible
from autotune.design.process_class import consistent_processes
from autotune.design.robust import design_on_points
from autotune.design.specification import UNCERTAIN, Design, Kind, Specification
from autotune.design.synthesis import design as synthesised
from autotune.errors import AutotuneError, DesignError
from autotune.identification.consistent_structures import consistent_structures
from autotune.identification.parametric import PlantFit, fit_plant
from autotune.identification.reduction import ReducedModel, reduce_points
from autotune.one_thread import on_one_thread
from autotune.points import FrequencyPoint, as_pairs
from autotune.progress import Progress, quiet

#: Below this phase [deg] a PI has no use for a point, and another turn could not be told from a rise.
LOWEST_PHASE_DEG = -270.0
#: A loop whose delay margin is below so many samples is not the continuous one that was designed.
_SAMPLES_OF_DELAY = 2.0

_T = TypeVar("_T")
Source: TypeAlias = Literal["reduced model", "points", "fitted plant"]


@dataclass(frozen=True, kw_only=True)
class Analysis:
    """What follows from the measurements alone, without a rig.

    Attributes
    ----------
    points : tuple of FrequencyPoint
        What was measured; may be empty where the plant was fitted to a recording.
    fit : PlantFit
        Transfer function through the points or the recording, for predictions and as a last check.
    reduced : ReducedModel or None
        Model whose margins are a guarantee; None where the points give none.
    design : Design
        Controller.
    source : {"reduced model", "points", "fitted plant"}
        What the controller was designed on.
    alternatives : tuple of (str, Design or str)
        What other bases of the design give: the reduced model, the points, the fitted plant; or why not.
    margins : Margins
        Of the controller on the fitted plant.
    checks : tuple of Check
        Of the controller on everything that was measured.
    unscaled, scaled : Validation or None
        Criterion (10) in the units of the signals, and scaled as the loop itself weighs them at its crossover.
    noise_source : str
        Where the noise gain comes from.
    warnings : tuple of str
        What the reader should know before relying on it.
    notes : tuple of str
        What limits the controller, in words for the terminal.
    """

    points: tuple[FrequencyPoint, ...]
    fit: PlantFit
    reduced: ReducedModel | None
    design: Design
    source: Source
    alternatives: tuple[tuple[str, Design | str], ...]
    margins: Margins
    checks: tuple[Check, ...]
    unscaled: Validation | None
    scaled: Validation | None
    noise_source: str
    warnings: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def controller(self) -> PIDController:
        """The controller."""
        return self.design.controller


def specification(
    settings: DesignSettings, plant: PlantFit, facts: LoopFacts, highest_rad_s: float
) -> tuple[Specification, str]:
    """Return the constraints that the configuration asks for, and where the noise gain comes from.

    Parameters
    ----------
    settings : DesignSettings
        What the configuration asks for.
    plant : PlantFit
        The fitted plant.
    facts : LoopFacts
        What is known of the loop besides.
    highest_rad_s : float
        Highest measured frequency [rad/s].
    """
    modulus, phase_rad = settings.margins
    noise_gain, words = settings.noise_gain, "asked for"
    if noise_gain is None:
        noise_gain, words = default_noise_gain(plant.plant, facts, highest_rad_s)
    criterion = settings.criterion
    if criterion == "auto":
        criterion = "iae" if plant.source == "recording" else "h2"
    asked = Specification(
        modulus_margin=modulus,
        phase_margin_rad=phase_rad,
        noise_gain=noise_gain,
        noise_frequency_rad_s=settings.noise_frequency_rad_s,
        delay_margin_s=_SAMPLES_OF_DELAY * _period(settings, facts),
        criterion=criterion,
    )
    return asked, words


@on_one_thread
def analyse(
    points: Sequence[FrequencyPoint],
    settings: DesignSettings,
    *,
    fit: PlantFit | None = None,
    facts: LoopFacts | None = None,
    compare: bool = True,
    progress: Progress = quiet,
) -> Analysis:
    """Fit, reduce, design and check.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        At least three, or none where ``fit`` is given; those past -270 degrees are left out, with a warning.
    settings : DesignSettings
        Structure, specification, and what to design on.
    fit : PlantFit, optional
        Plant fitted to a recording; fitted to the points where absent.
    facts : LoopFacts, optional
        Noise, range and sample time, for what the settings leave open.
    compare : bool
        Whether to design on the other bases too; on a plain recording's few points only where the settings ask for it.
    progress : Progress
        Told what is being done.

    Raises
    ------
    IdentificationError, DesignError
        The measurements do not determine a model, or no controller keeps the specification on all of them.
    """
    measured = sorted(points, key=lambda point: point.omega_rad_s)
    usable = of_use(measured)
    left_out = len(measured) - len(usable)
    said = ("point past {} deg was", "it") if left_out == 1 else ("points past {} deg were", "them")
    beyond = (f"{left_out} {said[0].format(f'{LOWEST_PHASE_DEG:g}')} left out: a PI has no use for {said[1]}",)
    fit = fit_plant(usable) if fit is None else fit
    usable = _as_independent(usable, fit)
    facts = facts or LoopFacts()
    asked, noise_source = specification(settings, fit, facts, _highest(usable, fit, facts))
    reduced = _reduce(usable, fit)
    bases = _bases(usable, fit, lambda: reduced, asked, settings.kind)
    progress("designing", 0.0)
    source, found, looked = _first_kept(bases, settings.source, usable, fit)
    model = reduced if isinstance(reduced, ReducedModel) else None
    H_r = None if model is None else model.transfer_function()
    controller = found.controller
    odd = implausible(fit.plant, controller, found.binding, _period(settings, facts))
    progress("designing on the other bases, for comparison", 0.5)
    # shown by their gains and margins: no bound on their norm is proved, which takes longer than all of them
    beside = _bases(usable, fit, lambda: reduced, asked, settings.kind, certificate=False)
    if fit.source == "recording":
        beside["points"] = _refuse_unasked
    others = tuple((name, _or_reason(make)) for name, make in beside.items() if name != source) if compare else ()
    return Analysis(
        points=tuple(measured),
        fit=fit,
        reduced=model,
        design=found,
        source=source,
        alternatives=others,
        margins=margins(fit.plant, controller, noise_frequency_rad_s=asked.noise_frequency_rad_s),
        checks=looked,
        unscaled=None if H_r is None else validate(fit.plant, H_r, controller),
        scaled=None if H_r is None else validate(fit.plant, H_r, controller, scaling=loop_scaling(H_r, controller)),
        noise_source=noise_source,
        warnings=(
            *(beyond if left_out else ()),
            *(model.warnings if source == "reduced model" and model is not None else ()),
            *([odd] if odd is not None else []),
            *([found.certificate] if UNCERTAIN in found.certificate else []),
        ),
        notes=_binding_words(found, noise_source, fit, settings),
    )


def on_measured(
    points: Sequence[FrequencyPoint], fit: PlantFit, asked: Specification, kind: Kind
) -> tuple[Source, Design, tuple[Check, ...]]:
    """Return what the controller was designed on, the design, and its checks on everything measured.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        Of use, see :func:`of_use`.
    fit : PlantFit
        Through them, or of the recording they come from.
    asked : Specification
        Constraints (18).
    kind : {"pi", "pid"}
        Structure.

    Raises
    ------
    IdentificationError, DesignError
        On no basis is there a controller that keeps its margins on all of it; the reason is that of the first.
    """
    return _first_kept(_bases(points, fit, lambda: _reduce(points, fit), asked, kind), "auto", points, fit)


def on_reduced_model(
    reduced: ReducedModel, asked: Specification, kind: Kind, *, certificate: bool = True
) -> tuple[Design, tuple[Check, ...]]:
    """Return the PI designed on a reduced model, and its checks on what that was reduced from.

    Parameters
    ----------
    reduced : ReducedModel
        With the plant or the points it bounds; without, the design's ``certificate`` says what is not known.
    asked : Specification
        Constraints (18).
    kind : {"pi", "pid"}
        ``pid`` is refused: the reduced model promises it nothing.
    certificate : bool
        Whether a lower bound of the norm on the reduced model is proven.

    Raises
    ------
    IdentificationError, DesignError
        No such controller keeps the margins on the reduced model and on what it was reduced from.
    """
    if reduced.points:
        fit = fit_plant(reduced.points)
        ways: dict[Source, Callable[[], Design]] = {
            "reduced model": lambda: design_on_reduced(
                reduced.plant or fit.plant, asked, kind, reduced=reduced, certificate=certificate
            )
        }
        _, found, looked = _first_kept(ways, "reduced model", reduced.points, fit)
        return found, looked
    known = reduced.transfer_function() if reduced.plant is None else reduced.plant
    found = design_on_reduced(known, asked, kind, reduced=reduced, certificate=certificate)
    if reduced.plant is None:
        said = "margins are kept on the reduced model; what it was reduced from is not known, and not checked"
        return replace(found, certificate=f"{said}; {found.certificate}"), ()
    return found, (on_plants((known,), found.controller, asked, "the plant that was reduced"),)


def _period(settings: DesignSettings, facts: LoopFacts) -> float:
    """Return the period of the controller [s], 0 where it is not known."""
    return settings.sample_time_s or facts.sample_time_s or 0.0


def _highest(points: Sequence[FrequencyPoint], fit: PlantFit, facts: LoopFacts) -> float:
    """Return the highest frequency [rad/s] at which something is known of the plant: a tenth of the sampling rate."""
    if fit.source == "recording" and facts.sample_time_s:
        return 0.2 * math.pi / facts.sample_time_s
    return points[-1].omega_rad_s


def _bases(
    points: Sequence[FrequencyPoint],
    fit: PlantFit,
    reduced: Callable[[], ReducedModel | AutotuneError],
    asked: Specification,
    kind: Kind,
    *,
    certificate: bool = True,
) -> dict[Source, Callable[[], Design]]:
    """Return the ways to a controller, the one to try first before the others.

    Points of a sweep bound every process of a wide class, which is the stronger guarantee; points of a plain recording
    are few and wide, and the plant fitted to the whole of it knows far more.
    """

    def on_reduced() -> Design:
        H_r = reduced()
        if isinstance(H_r, AutotuneError):
            raise H_r
        return design_on_reduced(fit.plant, asked, kind, reduced=H_r, certificate=certificate)

    ways: dict[Source, Callable[[], Design]] = {
        "points": lambda: design_on_points(points, asked, kind),
        "fitted plant": lambda: design_on_fit(fit, asked, kind),
        "reduced model": on_reduced,
    }
    return {name: ways[name] for name in sorted(ways, key=lambda name: fit.source == "recording" and name == "points")}


def _refuse_unasked() -> Design:
    """Refuse a design on a recording's few points that nobody asked for: it takes a third of all the time."""
    raise DesignError("not designed on beside the fitted plant: --source points does", where="points")


def _first_kept(
    bases: dict[Source, Callable[[], Design]],
    wanted: Source | Literal["auto"],
    points: Sequence[FrequencyPoint],
    fit: PlantFit,
) -> tuple[Source, Design, tuple[Check, ...]]:
    """Return the first design whose margins are kept on everything measured; refuse where there is none."""
    names = list(bases) if wanted == "auto" else [wanted]
    if wanted == "auto" and fit.source == "points":
        # nothing but the points is known: what they refuse, a model through them is no licence for
        names = ["points"]
    reason: AutotuneError | None = None
    for name in names:
        try:
            found = bases[name]()
        except AutotuneError as error:
            reason = reason or error
            continue
        looked = _checks(name, points, fit, found.controller, found.specification)
        missed = [check for check in looked if not check.kept]
        if not missed:
            return name, found, looked
        reason = reason or DesignError(
            f"the controller designed on the {name} misses the margins: " + "; ".join(one.sentence for one in missed),
            where="last check",
            remedy="measure more points, or with smaller regions",
        )
    assert reason is not None
    raise reason


def _checks(
    source: Source, points: Sequence[FrequencyPoint], fit: PlantFit, controller: PIDController, asked: Specification
) -> tuple[Check, ...]:
    # the others bound more than the fit's structure
    found = checks(points, fit, controller, asked, region=source == "fitted plant")
    if source != "points" and fit.source == "points":
        found = (*found, *_on_structures(points, controller, asked))
    if source == "points" and fit.source == "points" and fit.p_value < CONTRADICTED:
        # two lags and a dead time that the points contradict (as they do where there are nine lags) are no evidence
        # against a controller whose margins every process through the points keeps
        return found[1:]
    return found


def _on_structures(
    points: Sequence[FrequencyPoint], controller: PIDController, asked: Specification
) -> tuple[Check, ...]:
    """Return the check on the plants of low order through the points; none where aperiodic ones of any order remain.

    Raises
    ------
    DesignError
        No plant at all passes through the points.
    """
    plants = consistent_structures(points).plants
    if not plants:
        consistent_processes(points)
        return ()
    worst = worst_of(plants, controller, asked)
    return (on_plants(worst, controller, asked, "the plants of low order through the points"),)


def check_controller(analysis: Analysis, controller: PIDController) -> tuple[Check, ...]:
    """Return the checks of another controller than the designed one, as of gains that a rig rounds.

    Parameters
    ----------
    analysis : Analysis
        With points, fit and specification.
    controller : PIDController
        The one that is checked.
    """
    asked = analysis.design.specification
    usable = _as_independent(of_use(analysis.points), analysis.fit)
    return _checks(analysis.source, usable, analysis.fit, controller, asked)


def _binding_words(design: Design, noise_source: str, fit: PlantFit, settings: DesignSettings) -> tuple[str, ...]:
    """Return what to say of the constraints that hold the controller back."""
    if not design.binding:
        return ()
    words = f"what limits the controller: {', '.join(design.binding)}"
    if "noise gain" in design.binding:
        words += f" (at most {design.specification.noise_gain:.4g}: {noise_source}; --noise-gain sets another)"
    if "delay margin" in design.binding:
        words += _delay_words(design, fit, settings)
    return (words,)


def _delay_words(design: Design, fit: PlantFit, settings: DesignSettings) -> str:
    """Return what the controller's period costs, and where it was taken from where nobody said it."""
    asked = design.specification
    words = f"{_SAMPLES_OF_DELAY:g} periods of {asked.delay_margin_s / _SAMPLES_OF_DELAY:.4g} s"
    kept, free = (_norm(fit, one, design.kind) for one in (asked, replace(asked, delay_margin_s=0.0)))
    if kept is not None and free is not None:
        words += f" cost {100.0 * (kept / free - 1.0):.0f} % in the response to load"
    if settings.sample_time_s is None and fit.source == "recording":
        words += "; the period is the recording's, --sample-time says the controller's own"
    return f" ({words})"


def _norm(fit: PlantFit, asked: Specification, kind: Kind) -> float | None:
    """Return the norm (11) of the best controller for the estimate alone; None where there is none."""
    try:
        return synthesised(fit.plant, asked, kind, certificate=False).h2
    except DesignError:
        return None


def of_use(points: Sequence[FrequencyPoint]) -> list[FrequencyPoint]:
    """Return the points up to the frequency where the plant's phase, unwrapped from the lowest, is below -270 deg."""
    ordered = sorted(points, key=lambda point: point.omega_rad_s)
    if not ordered:
        return []
    phase = np.degrees(np.unwrap([point.phase_rad for point in ordered]))
    of_positive_gain = phase - 180.0 * math.ceil((phase[0] - 30.0) / 180.0)
    beyond = np.flatnonzero(of_positive_gain < LOWEST_PHASE_DEG)
    return ordered[: int(beyond[0])] if beyond.size else ordered


def _as_independent(points: Sequence[FrequencyPoint], fit: PlantFit) -> list[FrequencyPoint]:
    """Return points whose errors may count as independent: those of one fit share them, and get wider regions."""
    if fit.shared_errors == 1.0:
        return list(points)
    return [replace(one, covariance=as_pairs(fit.shared_errors * np.array(one.covariance))) for one in points]


def _reduce(points: Sequence[FrequencyPoint], fit: PlantFit) -> ReducedModel | AutotuneError:
    """Return the reduced model of the points, or why there is none."""
    try:
        return reduce_points(points, fit=fit if fit.source == "points" else None)
    except AutotuneError as error:
        return error


def _or_reason(make: Callable[[], _T]) -> _T | str:
    """Return what is made, or why it cannot be; only what was asked for may stop a run."""
    try:
        return make()
    except AutotuneError as error:
        return str(error)
