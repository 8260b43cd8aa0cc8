"""All rows of a sweep estimated together: which rows, beside a loop that goes on, and what is kept of it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from autotune.errors import AutotuneError
from autotune.experiment.cycles import Earlier
from autotune.experiment.loop import ControlLoop
from autotune.experiment.oscillation import Oscillation
from autotune.experiment.preflight import Known
from autotune.experiment.priority import GoesOn
from autotune.experiment.result import Segment
from autotune.identification.frequency.limit_cycle import WholePeriods
from autotune.identification.frequency.windows import Rows
from autotune.identification.sweep_estimate import SweepEstimate, estimate_sweep
from autotune.identification.sweep_noted import NOTED, is_noted
from autotune.recording import Recording

#: of an estimate, beside noise of this standard deviation [y unit]: by how much smaller, relative, the controller's
#: norm would be, were nothing left unknown of the plant
Price = Callable[[SweepEstimate, float], float]

#: the rest of a budget is left where it would make the norm smaller by less
WORTH = 0.01
#: rows before the first limit cycle are used for so many of its periods at most
PERIODS_BEFORE = 10.0


@dataclass(frozen=True, kw_only=True)
class Found:
    """What all rows of a sweep said so far.

    Attributes
    ----------
    estimate : SweepEstimate or None
        None where the rows determine no plant.
    why : str
        Why the estimate may not be used; empty where it may.
    price : float
        What is left unknown costs the controller, relative to its norm; NaN where nobody asked.
    """

    estimate: SweepEstimate | None
    why: str
    price: float = math.nan

    def wanted_sd(self, gain_sd: float, swept_s: float, budget_s: float) -> float:
        """Return the largest standard deviation of a point that is good enough.

        Where a price is known it is proportional to that standard deviation, which falls with the root of the time:
        the rest of the budget is worth price (1 - sqrt(swept / budget)) of the norm.

        Parameters
        ----------
        gain_sd : float
            What is good enough where no price is known, relative.
        swept_s, budget_s : float
            Rig time of the sweep so far, and all that it may take [s].
        """
        if self.estimate is None or math.isnan(self.price):
            return gain_sd
        return self.estimate.worst_sd * (WORTH / max(self.price, 1e-9) + math.sqrt(min(swept_s / budget_s, 1.0)))

    @property
    def words(self) -> str:
        """How well the points are known."""
        known = "" if self.estimate is None else f"all points are known to {100 * self.estimate.worst_sd:.2g} %"
        return known if math.isnan(self.price) else f"{known}, which costs the controller {100 * self.price:.2g} %"


def estimate_together(
    segments: Sequence[Segment], rows: Rows, phases_rad: Sequence[float], *, first_move_s: float, swing: float
) -> SweepEstimate:
    """Return the points of a sweep from all its rows.

    Parameters
    ----------
    segments : sequence of Segment
        Its limit cycles, in one recording.
    rows : ((N,) array, (N,) array, (N,) array)
        t [s], u, y of that recording.
    phases_rad : sequence of float
        Phases at which no cycle was run and a point is wanted, as they are of the plant, its sign included [rad].
    first_move_s : float
        When the plant first answered [s].
    swing : float
        Largest departure of y from the operating point [y unit]: rows before y came within it are left out.

    Raises
    ------
    IdentificationError, InputError
        The rows determine no plant.
    """
    t, u, y = rows
    first, end_s = segments[0], max(one.end_s for one in segments)
    period_s = (first.end_s - first.start_s) / first.periods
    far = t[(t < first.start_s) & (np.abs(y - first.settings.y_centre) > swing)]
    start_s = max(
        first_move_s if math.isfinite(first_move_s) else first.start_s,
        float(far[-1]) if far.size else -math.inf,
        first.start_s - PERIODS_BEFORE * period_s,
    )
    cycles = [(one.point, WholePeriods(start_s=one.start_s, end_s=one.end_s, periods=one.periods)) for one in segments]
    at = {one.phase_rad: one.point.omega_rad_s for one in reversed(segments)}  # one point at each phase
    recording = Recording(t=t, u=u, y=y, name="sweep")
    return estimate_sweep(recording, cycles, min(start_s, first.start_s), end_s, tuple(at.values()), phases_rad)


def estimate_beside(
    oscillation: Oscillation,
    segments: Sequence[Segment],
    phases_rad: Sequence[float],
    known: Known,
    look: int,
    price: Price | None = None,
) -> Found:
    """Return what all rows say together; where the rig's clock goes on, the relay does meanwhile.

    Parameters
    ----------
    oscillation : Oscillation
        What runs meanwhile, and holds the rows.
    segments, phases_rad : as of estimate_together
        The sweep so far.
    known : Known
        When the plant first answered, and the noise.
    look : int
        How often the sweep's rows are looked at, with this time.
    price : callable, optional
        Asked what is left unknown costs the controller.

    Raises
    ------
    ExperimentStopped, LinkError
        As a step of the relay.
    """
    loop = oscillation.loop
    rows, swing = loop.history(), loop.envelope.settings.swing
    found: list[Found] = []

    def work() -> None:
        try:
            one = estimate_together(segments, rows, phases_rad, first_move_s=known.first_move_s, swing=swing)
            why = one.refused(look)
            costs = math.nan if price is None or why else price(one, known.noise_sd)
            found.append(Found(estimate=one, why=why, price=costs))
        except AutotuneError as error:
            found.append(Found(estimate=None, why=str(error)))
        except (ArithmeticError, ValueError) as error:  # of a linear algebra that does not converge
            found.append(Found(estimate=None, why=f"the rows determine no plant: {error}"))

    if not goes_on(loop):
        work()
        return found[0]
    thread = threading.Thread(target=work, name="estimate of the sweep", daemon=True)  # no limit waits for its end
    thread.start()
    while thread.is_alive():
        oscillation.step()
    return found[0] if found else Found(estimate=None, why="the estimate failed")


def goes_on(loop: ControlLoop) -> bool:
    """Return whether the rig's time goes on while something is computed."""
    clock = loop.rig.clock
    return isinstance(clock, GoesOn) and clock.goes_on


def is_together(earlier: Earlier) -> bool:
    """Return whether the rows of the last sitting gave all points, and no cycle of theirs was lost."""
    last = len(earlier.recordings) - 1
    cycles = sum(one.part == last for one in earlier.segments)
    return last >= 0 and is_noted(earlier.recordings[last].metadata, cycles)


def was_tried(earlier: Earlier) -> bool:
    """Return whether a sitting has found that its rows do not give all points."""
    return any(NOTED in one.metadata for one in earlier.recordings)
