"""The rig's own controller on trial: the host starts it, asks its steps of it, and watches it row by row."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from autotune.controller import PIDController
from autotune.errors import AutotuneError, ExperimentStopped
from autotune.experiment.limits import Watch
from autotune.experiment.loop import ControlLoop
from autotune.experiment.rig import RunsOwnController
from autotune.experiment.running_law import LawRecord, RunningLaw, identify_running_law
from autotune.experiment.step_test import StepTest

#: times that the output may go from one limit to the other within a trial
FULL_SWINGS = 4
#: part of the range next to a limit that counts as the limit
NEAR = 0.05
#: rows that a law is told from
FEWEST_ROWS = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """What the rig's own controller did.

    Attributes
    ----------
    record : LawRecord
        All rows, those of the settling before the test included.
    test : StepTest
        What was asked, as the device's registers hold it.
    """

    record: LawRecord
    test: StepTest


def try_own_law(
    loop: ControlLoop,
    rig: RunsOwnController,
    controller: PIDController,
    test: StepTest,
    operating_y: float,
    tell: Callable[[int], None],
) -> Trial:
    """Give the actuator to the rig's own controller, and ask the test of it.

    Parameters
    ----------
    loop : ControlLoop
        Open, the rig at its operating point under a held command.
    rig : RunsOwnController
        The loop's rig; it holds the gains.
    controller : PIDController
        Those gains.
    test : StepTest
        What to ask.
    operating_y : float
        Operating point [y unit].
    tell : callable
        Told the number of each sample.

    Raises
    ------
    ExperimentStopped, LinkError, OperatorStop
        From the loop; of a limit, with what the controller computes as far as its rows tell.
    """
    loop.watch = Watch(y_centre=operating_y, in_range=True)
    rows = _Rows(loop, test, operating_y)
    try:
        rows.r = rig.start_controller(operating_y)
        for k in range(test.settle + test.t.size):
            tell(k)
            rows.take(loop)
            asked = test.asked(k - test.settle)
            if asked != rows.asked:
                rows.asked = asked
                rows.r, rows.load = rig.ask_controller(operating_y + asked[0], asked[1])
            rows.held.append((rows.r - operating_y, rows.load))
            loop.observe(extra={"r": rows.r})
        rig.ask_controller(operating_y, 0.0)  # which looks whether all that was asked stood until now
    except ExperimentStopped as error:
        if (law := rows.law(rig, controller)) is not None and not law.is_given:
            error.what += f"; {law.sentence}"
            error.remedy = (
                "compare the register map with the device's manual: order of words, units and form of the gains"
            )
        raise
    return rows.trial()


class _Rows:
    """What was asked and measured, row by row."""

    def __init__(self, loop: ControlLoop, test: StepTest, operating_y: float) -> None:
        limits = loop.envelope.settings
        self.asked = (0.0, 0.0)
        self.held: list[tuple[float, float]] = []
        self.r, self.load = operating_y, 0.0
        self._test = test
        self._range = (limits.u_min, limits.u_max)
        self._sample_time_s = loop.sample_time_s
        self._rows: list[tuple[float, float, float, float]] = []
        self._side, self._swings = 0, 0

    def take(self, loop: ControlLoop) -> None:
        """Take the present sample into the rows, with what was asked before it.

        Raises
        ------
        ExperimentStopped
            The output goes from limit to limit.
        """
        tick, u = loop.tick, loop.applied
        self._rows.append((tick.y if tick.usable else np.nan, u - self.load, self.r, self.load))
        low, high = self._range
        side = -1 if u <= low + NEAR * (high - low) else 1 if u >= high - NEAR * (high - low) else 0
        self._swings += side * self._side < 0
        self._side = side or self._side
        if self._swings > FULL_SWINGS:
            raise ExperimentStopped(
                f"the device's own controller drives the output from limit to limit, {self._swings} times",
                where="trial of the device's own controller",
                remedy="check gains, units and order of words in the register map",
            )

    @property
    def record(self) -> LawRecord:
        """The rows."""
        y, u, r, load = (np.array(column) for column in zip(*self._rows, strict=True))
        return LawRecord(
            y=y, u=u, r=r, load=load,
            sample_time_s=self._sample_time_s, u_range=self._range, smoothing=self._test.smoothing,
        )  # fmt: skip

    def law(self, rig: RunsOwnController, controller: PIDController) -> RunningLaw | None:
        """Return what ran, None where there are too few rows to tell."""
        if len(self._rows) < FEWEST_ROWS:
            return None
        return law_of(self.record, rig, controller)

    def trial(self) -> Trial:
        """Return the finished trial."""
        setpoint, load = (np.array(column) for column in zip(*self.held[self._test.settle :], strict=True))
        return Trial(record=self.record, test=replace(self._test, setpoint=setpoint, disturbance=load))


def law_of(record: LawRecord, rig: RunsOwnController, controller: PIDController) -> RunningLaw:
    """Return what a rig's own controller ran."""
    try:
        misread = rig.misread(controller)
    except AutotuneError:
        misread = {}
    return identify_running_law(record, controller, misread=misread, misread_setpoint=rig.misread_setpoint)
