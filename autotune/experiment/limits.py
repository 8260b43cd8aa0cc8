"""Safety envelope: a pure check of every command and every measurement, in every state."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import median

from autotune.config.procedure import LimitSettings
from autotune.errors import ExperimentStopped

#: relative slack of the rate check: a command on the border of what is allowed is allowed in spite of rounding
RATE_SLACK = 1e-9
#: part of limits.swing by which y may go beyond where it started, on its way to the operating point from further off
START_ROOM = 0.5
#: samples without a usable reading that are ridden through where no time is given
BLIND_SAMPLES = 5


@dataclass(frozen=True, kw_only=True)
class Watch:
    """Which limits on y apply in the present state of the procedure.

    Attributes
    ----------
    y_centre : float or None
        Operating point that the swing is counted from [y unit]; None where it does not apply.
    in_range : bool
        Whether y_min and y_max apply.
    y_start : float or None
        Where y was when the way to the operating point began [y unit]; None where y is there. A rig that begins beyond
        a limit is given room there, see :meth:`reach` and :meth:`range`.
    """

    y_centre: float | None = None
    in_range: bool = False
    y_start: float | None = None

    def reach(self, swing: float) -> float:
        """Return how far y may be from the operating point [y unit]: the swing, or START_ROOM beyond where it began.

        Parameters
        ----------
        swing : float
            ``limits.swing`` [y unit].
        """
        if self.y_start is None or self.y_centre is None:
            return swing
        return max(swing, abs(self.y_start - self.y_centre) + START_ROOM * swing)

    def range(self, limits: LimitSettings) -> tuple[float, float]:
        """Return y_min and y_max [y unit], or on the way START_ROOM beyond a start that is not between them."""
        low, high, room = limits.y_min, limits.y_max, START_ROOM * limits.swing
        if self.y_start is None:
            return low, high
        return (
            low if self.y_start >= low else self.y_start - room,
            high if self.y_start <= high else self.y_start + room,
        )


@dataclass(frozen=True, kw_only=True)
class Patience:
    """How much of something bad in a row is ridden through.

    Attributes
    ----------
    seconds : float
        Longest time [s].
    samples : float
        Most samples, which are fewer where they come on time; infinite for the time alone.
    """

    seconds: float
    samples: float = math.inf

    def is_over(self, seconds: float, samples: float, times: float = 1.0) -> bool:
        """Return whether something bad has lasted longer than is ridden through.

        Parameters
        ----------
        seconds, samples : float
            How long it lasts [s], and over how many samples.
        times : float
            Factor on both limits.
        """
        return samples > times * self.samples or seconds > times * self.seconds


@dataclass(frozen=True, kw_only=True)
class Envelope:
    """The limits of ``[limits]`` as functions.

    Attributes
    ----------
    settings : LimitSettings
        The limits.
    sample_time_s : float
        Control period that the rate of u is counted over [s].
    u_step : float
        Resolution of the command [u unit]; 0 for any value.
    """

    settings: LimitSettings
    sample_time_s: float
    u_step: float = 0.0

    @property
    def patience(self) -> Patience:
        """How long the loop rides on its last command without a usable reading."""
        given = self.settings.blind_s
        if given is not None:
            return Patience(seconds=given + 0.5 * self.sample_time_s)
        late_s = max(self.settings.late_s, BLIND_SAMPLES * self.sample_time_s)
        return Patience(seconds=late_s + 0.5 * self.sample_time_s, samples=BLIND_SAMPLES)

    def nearest(self, u: float, u_previous: float) -> float:
        """Return the allowed command nearest to ``u``: within range and rate, on the converter's grid.

        A controller with anti-windup asks this first and feeds the answer back; nothing is clipped silently later.

        Parameters
        ----------
        u, u_previous : float
            Wanted command and the one held now [u unit].

        Raises
        ------
        ExperimentStopped
            The wanted command is not a number.
        """
        if not math.isfinite(u):
            raise ExperimentStopped(
                "the command is not a number", remedy="report this, it is a defect of the control law"
            )
        low, high = self._reach(u_previous)
        u = min(max(u, low), high)
        if self.u_step > 0.0:
            u = self.u_step * round(u / self.u_step)
            u = u + self.u_step if u < low else u - self.u_step if u > high else u
            u = min(max(u, low), high)  # a reach narrower than one step leaves the command between two steps
        return u

    def check_command(self, u: float, u_previous: float) -> None:
        """Let a command pass, or stop the experiment.

        Parameters
        ----------
        u, u_previous : float
            The command, and the one that it follows [u unit].

        Raises
        ------
        ExperimentStopped
            Not a number, outside u_min..u_max, or further from ``u_previous`` than u_rate allows in one sample.
        """
        limits = self.settings
        if not math.isfinite(u):
            raise ExperimentStopped(
                "the command is not a number", remedy="report this, it is a defect of the control law"
            )
        if not limits.u_min <= u <= limits.u_max:
            raise ExperimentStopped(
                f"limit reached: the command {u:g} is outside {limits.u_min:g}..{limits.u_max:g}",
                remedy="widen limits.u_min..u_max if the rig stands it, or ask for a smaller relay_amplitude",
            )
        low, high = self._reach(u_previous)
        if not low <= u <= high:
            raise ExperimentStopped(
                f"limit reached: the command moved from {u_previous:g} to {u:g} within one sample,"
                f" more than limits.u_rate = {limits.u_rate:g} per second allows",
                remedy="raise limits.u_rate if the rig stands it",
            )

    def check_measurement(self, recent: tuple[float, ...], watch: Watch, noise: float = 0.0) -> None:
        """Let the latest measurements pass, or stop the experiment.

        Parameters
        ----------
        recent : tuple of float
            The last readings, the newest last [y unit]; their median is judged, so that one wild reading is survived.
        watch : Watch
            Which limits apply.
        noise : float
            Known half-width of the measurement noise [y unit]; the limits are for the plant and not for the noise.

        Raises
        ------
        ExperimentStopped
            Out of y_min..y_max, or further than the swing from the operating point.
        """
        y = median(recent)
        limits = self.settings
        slack = noise if len(recent) > 1 else 0.0
        low, high = watch.range(limits)
        if watch.in_range and not low - slack <= y <= high + slack:
            raise ExperimentStopped(
                f"limit reached: y = {y:.4g} is outside y_min..y_max = {limits.y_min:g}..{limits.y_max:g}",
                remedy="look for a load on the rig, or widen limits.y_min..y_max if the rig stands it",
            )
        if watch.y_centre is None or abs(y - watch.y_centre) <= watch.reach(limits.swing) + slack:
            return
        if watch.y_start is None:
            raise ExperimentStopped(
                f"limit reached: y = {y:.4g} is more than limits.swing = {limits.swing:g}"
                f" from the operating point {watch.y_centre:g}",
                remedy="ask for a smaller relay_amplitude, or allow more swing",
            )
        raise ExperimentStopped(
            f"limit reached: y = {y:.4g} left limits.swing = {limits.swing:g} around the operating point"
            f" {watch.y_centre:g} while the way to it was sought from {watch.y_start:.4g}",
            remedy="correct operating_point.u_guess; give less u_uncertainty, which the command is moved by; or allow"
            " more swing",
        )

    def check_time(self, elapsed_s: float) -> None:
        """Stop the experiment when its time is over.

        Raises
        ------
        ExperimentStopped
            More than limits.time_s has passed.
        """
        if elapsed_s > self.settings.time_s:
            raise ExperimentStopped(
                f"time over: {elapsed_s:.4g} s on the rig", remedy="raise limits.time_s, or ask for fewer points"
            )

    def _reach(self, u_previous: float) -> tuple[float, float]:
        limits = self.settings
        step = limits.u_rate * self.sample_time_s * (1.0 + RATE_SLACK)
        return max(limits.u_min, u_previous - step), min(limits.u_max, u_previous + step)
