"""A plant identified from a recording of its loop: r, u and y as a person's own rig gives them.

The method is direct: the response from u to y is estimated with a noise model, by PBSIDopt and a prediction-error
polish, and the controller need not be known. The feedback does no harm because the noise is modelled; r, where it was
recorded, tells whether the loop was moved from outside, and a controller file is checked against the data.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import ComplexArray, FloatArray, is_constant
from autotune.controller import Controller
from autotune.errors import IdentificationError, InputError
from autotune.identification.closed_loop.confidence import (
    Whiteness,
    pole_covariance,
    residuals,
    whiteness,
)
from autotune.identification.closed_loop.control_law import CONTRADICTION, LawCheck, check_law
from autotune.identification.closed_loop.dither_proposal import DitherLimits, DitherProposal, propose_dither
from autotune.identification.closed_loop.gaps import usable_stretches
from autotune.identification.closed_loop.loop_excitation import ExcitationVerdict, judge, own_motion, require_excitation
from autotune.identification.closed_loop.order import Candidate, choose_order, default_past_window, fit_order
from autotune.identification.closed_loop.prediction_error import PredictionErrorEstimate
from autotune.identification.closed_loop.series import Series
from autotune.identification.closed_loop.structures import Structures, Weighted
from autotune.identification.closed_loop.subspace_direct import lagged_data
from autotune.one_thread import on_one_thread
from autotune.points import FrequencyPoint
from autotune.progress import Progress, quiet
from autotune.recording import Recording

#: Rows that a first look at the excitation takes.
_LOOK_ROWS = 20_000
#: Fewest rows of a stretch that is used beside others.
_SHORTEST = 30
#: Poles and zeros of the noise model beyond this are one for all that a record can tell.
_ON_THE_CIRCLE = 0.999


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedLoopIdentification:
    """What a recording of the loop says about the plant.

    Attributes
    ----------
    structures : Structures
        Polished model in the recording's units, and those of other orders and dead times that the record leaves open.
    poles : (n,) array
        In the z plane, slowest first.
    pole_covariance : (n, 2, 2) array
        Covariance of (re, im).
    response : tuple of FrequencyPoint
        G(exp(j omega Ts)), consistent with the polynomials.
    points : tuple of FrequencyPoint
        The plant's own response with the hold taken out, comparable with points from a relay; only where it is known
        to better than 50 %.
    design_points : tuple of FrequencyPoint
        As many of these as are independent, around the frequency of -135 degrees.
    evidence : tuple of Candidate
        Orders and dead times tried, the best first; empty where the order was given.
    excitation : ExcitationVerdict
        Whether the loop was moved enough.
    proposal : DitherProposal or None
        Dither that would be enough; None where the loop was excited enough.
    whiteness : Whiteness
        Test of the residuals.
    law : LawCheck or None
        Agreement with the controller file.
    warnings : tuple of str
        What a reader should know before relying on the result.
    """

    structures: Structures
    poles: ComplexArray
    pole_covariance: FloatArray
    response: tuple[FrequencyPoint, ...]
    points: tuple[FrequencyPoint, ...]
    design_points: tuple[FrequencyPoint, ...]
    evidence: tuple[Candidate, ...]
    excitation: ExcitationVerdict
    proposal: DitherProposal | None
    whiteness: Whiteness
    law: LawCheck | None
    warnings: tuple[str, ...]

    @property
    def estimate(self) -> PredictionErrorEstimate:
        """The polished model."""
        return self.structures.chosen


@on_one_thread
def identify_closed_loop(
    recording: Recording,
    *,
    order: int | None = None,
    delay: int | None = None,
    controller: Controller | None = None,
    max_order: int = 8,
    omega_rad_s: FloatArray | None = None,
    limits: DitherLimits | None = None,
    progress: Progress = quiet,
) -> ClosedLoopIdentification:
    """Identify the plant from a recording of the loop under control.

    Parameters
    ----------
    recording : Recording
        t, u, y, and r where it is known; its equidistant stretches are used together, each with an initial state of its
        own. A column ``dither`` is what was added to the controller's output.
    order : int, optional
        Number of states; chosen from the data when absent.
    delay : int, optional
        Dead time in whole samples on top of the one that every sampled loop has; chosen with the order when absent,
        0 where only the order is given.
    controller : Controller, optional
        Checked against the data, and used to say at which frequency the plant matters.
    max_order : int
        Highest order tried.
    omega_rad_s : (W,) array, optional
        Frequencies of the response [rad/s]; 40 from a period of a third of the record to 0.8 of Nyquist when absent.
    limits : DitherLimits, optional
        Of the rig, for the dither that is proposed where the loop was not excited enough; what u and y did in the
        recording when absent.
    progress : callable
        Told what is being done and the share done.

    Returns
    -------
    ClosedLoopIdentification

    Raises
    ------
    InputError
        A controller that contradicts the data.
    IdentificationError
        Too few equidistant rows, a command that does not move or only by the feedback, a plant of the asked order that
        the data do not determine.

    Notes
    -----
    Linear and time-invariant over the record; regions are asymptotic, presume white residuals (tested), and count other
    orders and dead times that the record leaves open, where the order was chosen from it. Means are removed and a
    constant is estimated, so operating points and integrators need no care.
    """
    pieces, left_out = usable_stretches(recording, max(_SHORTEST, 3 * (order or 0)))
    warnings = list(left_out)
    longest, starts = max(pieces, key=len), _starts(pieces)
    u, y, r = _columns(pieces)
    dt_s = longest.sample_time_s
    law = _check_law(longest, controller, r is not None, warnings)
    scale_u, scale_y = float(np.std(u)), float(np.std(y))
    u_1, y_1 = ((u - u.mean()) / scale_u)[:, None], ((y - y.mean()) / scale_y)[:, None]
    motion = _look(u_1, y_1, r, starts, recording.name)
    estimate, others, evidence = _fit(u_1, y_1, starts, order, delay, max_order, progress)
    white = whiteness(estimate, residuals(estimate, u_1, y_1, starts))
    found = Structures(
        chosen=_in_units(estimate, scale_u, scale_y, dt_s),
        others=tuple((weight, _in_units(one, scale_u, scale_y, dt_s)) for weight, one in others),
    )
    omega = _grid(dt_s, len(y)) if omega_rad_s is None else _below_nyquist(omega_rad_s, dt_s)
    result = _report(found, omega, law, motion, white)
    if not result.excitation.enough:
        result = replace(result, proposal=_proposal(result, limits or _recorded_limits(u, y)))
    _further_warnings(result, evidence, r, warnings)
    return replace(result, evidence=evidence, warnings=tuple(warnings))


def _fit(
    u: FloatArray,
    y: FloatArray,
    starts: tuple[int, ...],
    order: int | None,
    delay: int | None,
    max_order: int,
    progress: Progress,
) -> tuple[PredictionErrorEstimate, tuple[Weighted, ...], tuple[Candidate, ...]]:
    if order is None:
        choice = choose_order(u, y, max_order=max_order, progress=progress, starts=starts)
        return choice.estimate, choice.others, choice.evidence
    if order < 1 or (delay or 0) < 0:
        raise InputError(f"order {order}, delay {delay}", remedy="the order is at least 1, the dead time at least 0")
    progress(f"order {order}", 0.0)
    return fit_order(u, y, order, delay=delay or 0, starts=starts), (), ()


def _starts(pieces: Sequence[Recording]) -> tuple[int, ...]:
    """Return where each of the pieces begins when they are put one after the other."""
    return tuple(int(row) for row in np.cumsum([0, *(len(piece) for piece in pieces[:-1])]))


def _columns(pieces: Sequence[Recording]) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    u, y = (np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("u", "y"))
    for name, values in (("u", u), ("y", y)):
        if is_constant(values):
            raise IdentificationError(
                f"{name} does not move", where=pieces[0].name, remedy="move the set-point or add a dither"
            )
    if "r" not in pieces[0].extra:
        return u, y, None
    r = np.concatenate([piece["r"] for piece in pieces])
    return u, y, r if np.all(np.isfinite(r)) else None


def _check_law(
    recording: Recording, controller: Controller | None, has_r: bool, warnings: list[str]
) -> LawCheck | None:
    if controller is None:
        return None
    r = recording.extra["r"] if has_r else None
    added = recording.extra.get("dither")
    added = added if added is not None and np.all(np.isfinite(added)) else None
    law = check_law(controller, recording.u, recording.y, r, recording.sample_time_s, added=added)
    left = law.beyond_rounding
    if law.contradicts and r is None:
        warnings.append("r was not recorded, so the controller file cannot be checked against the data")
        return law
    if law.contradicts:
        hint = f"; a gain {law.gain_ratio:.3g} times as large would explain most" if law.gain_ratio > 0 else ""
        raise InputError(
            f"the controller file contradicts the data: {100 * left:.0f} % of the command's motion does not "
            f"come from this law (at most {100 * CONTRADICTION:.0f} % may){hint}",
            where=recording.name,
            remedy="correct the file, or leave --controller away: the plant is identified without it",
        )
    if left > CONTRADICTION / 5.0:
        warnings.append(f"the controller file leaves {100 * left:.1f} % of the command's motion unexplained")
    return law


def _look(u: FloatArray, y: FloatArray, r: FloatArray | None, starts: tuple[int, ...], name: str) -> float:
    few = Series(u=u, y=y, starts=starts).head(_LOOK_ROWS)
    p = min(12, default_past_window(len(few), 2))
    motion = own_motion(lagged_data(few.u, few.y, p, few.starts))
    require_excitation(motion, r_recorded=r is not None, r_moves=r is not None and not is_constant(r), where=name)
    return motion


def _in_units(
    estimate: PredictionErrorEstimate, scale_u: float, scale_y: float, sample_time_s: float
) -> PredictionErrorEstimate:
    """Return an estimate made on scaled signals (u / scale_u, y / scale_y) in the signals' own units."""
    model = estimate.model
    return replace(
        estimate,
        model=model.in_units(np.array([scale_u]), np.array([scale_y]), sample_time_s),
        d_b=estimate.d_b / scale_u,
        d_c=estimate.d_c * scale_y,
        d_k=estimate.d_k / scale_y,
        offset_y=estimate.offset_y * scale_y,
        log_det=estimate.log_det + 2.0 * math.log(scale_y) * model.C.shape[0],
    )


def _below_nyquist(omega_rad_s: FloatArray, dt_s: float) -> FloatArray:
    omega = np.asarray(omega_rad_s, dtype=np.float64)
    if omega.size < 2 or np.any(np.diff(omega) <= 0.0) or not (omega[0] > 0.0 and omega[-1] <= 1.001 * np.pi / dt_s):
        raise IdentificationError(
            f"{omega.size} frequencies from {omega[0]:.3g} to {omega[-1]:.3g} rad/s",
            remedy=f"give at least two, ascending, above 0 and up to {np.pi / dt_s:.4g} rad/s (a row every {dt_s:g} s)",
        )
    return omega


def _grid(sample_time_s: float, rows: int) -> FloatArray:
    nyquist = math.pi / sample_time_s
    lowest = min(6.0 * math.pi / (sample_time_s * (rows - 1)), 0.1 * nyquist)
    return np.geomspace(lowest, 0.8 * nyquist, 40)


def _report(
    found: Structures, omega: FloatArray, law: LawCheck | None, motion: float, white: Whiteness
) -> ClosedLoopIdentification:
    estimate, (response, points) = found.chosen, found.points(omega)
    covariance = np.array([point.covariance for point in response])
    plant = np.array([point.response for point in response])
    loop = None if law is None or law.contradicts else law.controller.response(omega)
    return ClosedLoopIdentification(
        structures=found,
        poles=estimate.model.poles,
        pole_covariance=pole_covariance(estimate),
        response=response,
        points=points,
        design_points=found.design_points(omega),
        evidence=(),
        excitation=judge(omega, plant, covariance, controller=loop, motion=motion),
        proposal=None,
        whiteness=white,
        law=law,
        warnings=(),
    )


def _recorded_limits(u: FloatArray, y: FloatArray) -> DitherLimits:
    """Return limits that keep a dither within what command and measurement did in a recording."""
    amplitude, departure = (float(np.max(np.abs(x - np.mean(x)))) for x in (u, y))
    return DitherLimits(amplitude=amplitude, departure=departure, source="what u and y did in this recording")


def _proposal(result: ClosedLoopIdentification, limits: DitherLimits) -> DitherProposal:
    known = result.law is not None and not result.law.contradicts
    law = result.law.controller if result.law is not None and known else None
    return propose_dither(result.estimate, result.excitation.band_rad_s, limits, controller=law)


def _further_warnings(
    result: ClosedLoopIdentification, evidence: tuple[Candidate, ...], r: FloatArray | None, warnings: list[str]
) -> None:
    if r is None:
        warnings.append("r was not recorded: the result relies on u being moved by more than the feedback")
    if not result.excitation.enough:
        warnings.append(result.excitation.sentence)
    if result.proposal is not None:
        warnings.append(result.proposal.sentence)
    if result.whiteness.probability < 0.001:
        warnings.append(
            f"the residuals are not white (probability {result.whiteness.probability:.1g}): the model leaves dynamics "
            "or a nonlinearity out, and its regions are too small"
        )
    model = result.estimate.model
    spread = 2.0 * np.sqrt(np.trace(result.pole_covariance, axis1=1, axis2=2))
    integrators = int(np.sum(np.abs(result.poles) > _ON_THE_CIRCLE - spread))
    trends = int(np.sum(np.abs(np.linalg.eigvals(model.A - model.K @ model.C)) > _ON_THE_CIRCLE))
    if trends > integrators and not result.estimate.noise_free:
        warnings.append(
            f"the noise model takes out more trends ({trends}) than the plant integrates ({integrators}): the record "
            "is too short to tell noise from drift, and the regions are too small; record several times as long"
        )
    if not result.estimate.converged:
        warnings.append("the polish stopped before it converged; try a lower --order")
    if evidence and model.order == max(candidate.order for candidate in evidence):
        warnings.append(f"the best order is the highest tried, {model.order}: try --max-order")
