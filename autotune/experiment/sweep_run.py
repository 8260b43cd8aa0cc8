"""A relay sweep on its way: its limit cycles so far, what they tell, and the next one run."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from autotune.config.procedure import ExperimentSettings
from autotune.errors import ExperimentStopped, IdentificationError
from autotune.experiment.cycles import Earlier, measure_cycle, noise_of
from autotune.experiment.limit_cycle_run import run_limit_cycle
from autotune.experiment.limits import Envelope
from autotune.experiment.loop import ControlLoop
from autotune.experiment.oscillation import Oscillation
from autotune.experiment.plan import PEAK_SHARE, Choice, Goal, choose
from autotune.experiment.preflight import Known
from autotune.experiment.relay import RelaySettings
from autotune.experiment.result import Cycle, Segment, State
from autotune.experiment.sweep_warnings import relative_sd, sweep_warnings
from autotune.experiment.together import Found, Price, estimate_beside
from autotune.identification.sweep_noted import NOTED, note_of

#: part of limits.swing that a first point is planned for, its gain foreseen from a short look, and those far apart
FIRST_PEAK_SHARE = 0.79

Show = Callable[[str, float, Known, RelaySettings], None]


class SweepRun:
    """A sweep on its way: its limit cycles so far, and what they tell.

    Attributes
    ----------
    segments : list of Segment
        Finished limit cycles that give points, the earlier ones first.
    cycles : list of Segment
        All limit cycles of this sitting.
    looks : int
        How often their rows were asked for all points together.
    known : Known
        What was learnt.
    settled : bool
        Whether the cycle before has the same peak: the next one, begun where y turns, is settled from its first row on.
    by_itself : bool
        Whether each point is of its own cycle: then it is said how well it is known.
    far : bool
        Whether the next cycle's frequency is far from the last one's, so that its gain is foreseen from afar.
    """

    def __init__(
        self,
        *,
        loop: ControlLoop,
        y_centre: float,
        wanted: ExperimentSettings,
        oscillation: Oscillation,
        show: Show,
        earlier: Earlier,
    ) -> None:
        self.loop, self.y_centre, self.wanted, self.oscillation = loop, y_centre, wanted, oscillation
        self._show, self._part = show, len(earlier.recordings)
        self.segments = list(earlier.segments)
        self.cycles: list[Segment] = []
        self.looks = 0
        self.settled, self.by_itself, self.far = False, False, False
        self.known = Known()

    def know(self, known: Known) -> None:
        """Take what is known, and the points measured so far."""
        if self.segments:
            points = tuple(one.point for one in self.segments)
            warnings = sweep_warnings(self.segments, self.wanted, known.link_rad_s) if self.by_itself else ()
            known = replace(known, points=points, swept=True, warnings=warnings)
        self.known = known

    def measure_each(self) -> None:
        """Go on with a point of each cycle's own rows, the best known of each phase; a cycle replaces its phase's."""
        best = {one.phase_rad: one for one in sorted(self.segments, key=relative_sd, reverse=True)}
        self.by_itself = True
        self.segments = [one for one in self.segments if best[one.phase_rad] is one]
        self.know(self.known)

    def tell(self, message: str, remaining_s: float, settings: RelaySettings | None = None) -> None:
        """Say what happens.

        Parameters
        ----------
        message : str
            What.
        remaining_s : float
            Rig time that is expected to remain [s]; NaN where nobody can know.
        settings : RelaySettings, optional
            Relay that will run; the one that runs where None.
        """
        self._show(message, remaining_s, self.known, settings or self.oscillation.settings)

    @property
    def goal(self) -> Goal:
        """What the next limit cycle works under."""
        share = PEAK_SHARE if self.known.swept and not self.far else FIRST_PEAK_SHARE
        return _goal(self.loop.envelope, share, self.wanted.relay_amplitude, self.known)

    def choices(self, phases_rad: Sequence[float]) -> list[Choice]:
        """Return the settings for the phases as the plant is known now."""
        return [_choice(self.goal, self.y_centre, self.known, phase) for phase in phases_rad]

    def cycle(self, choice: Choice, periods: int, until_s: float) -> None:
        """Run a limit cycle of so many whole periods, or until its time is over, and take its point.

        Parameters
        ----------
        choice : Choice
            Its relay and what is expected of it.
        periods : int
            Whole periods.
        until_s : float
            When its time is over, in the recording's time [s].

        Raises
        ------
        ExperimentStopped
            A limit, no oscillation, or rows that give no point.
        """
        loop, known = self.loop, self.known
        foreseen = known.swept and self.wanted.relay_amplitude is None
        window = run_limit_cycle(self.oscillation, choice, periods, until_s, settled=self.settled, foreseen=foreseen)
        cycle = Cycle(
            part=self._part,
            phase_rad=choice.phase_rad,
            settings=self.oscillation.settings,
            start_s=window.start_s,
            end_s=window.end_s,
            periods=window.periods,
        )
        try:
            segment = measure_cycle(cycle, loop.history(), loop.sample_time_s, known.points if known.swept else ())
        except IdentificationError as error:
            raise ExperimentStopped(error.what, where=State.SWEEP.value, remedy=error.remedy) from error
        if self.by_itself:
            self.segments = [one for one in self.segments if one.phase_rad != choice.phase_rad]
        self.segments.append(segment)
        self.cycles.append(segment)
        self.settled = True
        self._note_cycles()
        self.know(replace(known, midpoint=segment.u_mean, noise_sd=noise_of(self.segments)))

    def _note_cycles(self) -> None:
        self.loop.note(relay=[one.to_table() for one in self.segments if one.part == self._part])

    def look(self, phases_rad: Sequence[float], price: Price | None = None) -> Found:
        """Estimate all points from all rows together.

        Parameters
        ----------
        phases_rad : sequence of float
            Phases of the positive-gain plant at which points are wanted [rad].
        price : callable, optional
            Asked what is left unknown costs the controller.

        Returns
        -------
        Found
            Its ``why`` says why the points may not be used, commands of another master included.
        """
        self.looks += 1
        self.tell("estimating all points together", 0.0)
        others = self._remaining_phases(phases_rad)
        found = estimate_beside(self.oscillation, self.cycles, others, self.known, self.looks, price)
        return replace(found, why="commands of another master" if self.loop.monitor.commands.found else found.why)

    def note_look(self, found: Found, phases_rad: Sequence[float]) -> None:
        """Note what came of a look that ends the sweep, or sends it to cycles of their own: a resumed one goes by it.

        Parameters
        ----------
        found : Found
            What came of it.
        phases_rad : sequence of float
            Phases of the positive-gain plant at which points were wanted [rad].
        """
        noted = note_of(found.estimate, found.why, len(self.cycles), self._remaining_phases(phases_rad))
        self.loop.note(**{NOTED: noted})

    def _remaining_phases(self, phases_rad: Sequence[float]) -> list[float]:
        """Return the phases without a limit cycle, as they are of the plant, its sign included."""
        turned = 0.0 if self.known.plant_sign > 0 else math.pi
        return [phase + turned for phase in phases_rad if not is_aimed(phase, self.cycles)]

    def take_together(self) -> None:
        """Let all limit cycles of this sitting give the points together."""
        self.by_itself, self.segments = False, list(self.cycles)
        self._note_cycles()
        self.know(replace(self.known, warnings=()))


def is_aimed(phase_rad: float, segments: Sequence[Segment]) -> bool:
    """Return whether a limit cycle aimed at a phase.

    Parameters
    ----------
    phase_rad : float
        Phase of the positive-gain plant [rad].
    segments : sequence of Segment
        Limit cycles.
    """
    return any(math.isclose(phase_rad, one.phase_rad) for one in segments)


def _goal(envelope: Envelope, peak_share: float, amplitude: float | None, known: Known) -> Goal:
    limits = envelope.settings
    return Goal(
        peak=peak_share * limits.swing,
        noise_sd=known.noise_sd,
        sample_time_s=envelope.sample_time_s,
        u_step=envelope.u_step,
        u_room=0.95 * min(known.midpoint - limits.u_min, limits.u_max - known.midpoint),
        amplitude=amplitude,
    )


def _choice(goal: Goal, y_centre: float, known: Known, phase_rad: float) -> Choice:
    midpoint = known.midpoint
    if goal.u_step > 0.0:
        midpoint = goal.u_step * round(midpoint / goal.u_step)
    return choose(
        known.points,
        phase_rad,
        goal,
        midpoint=midpoint,
        y_centre=y_centre,
        plant_sign=known.plant_sign,
    )
