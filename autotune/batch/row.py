"""A loop's row in a campaign's table of results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from pydantic import ConfigDict

Attention: TypeAlias = Literal["act", "failed", "look", "designed", "fine"]

#: What comes first in the table.
ATTENTION: tuple[Attention, ...] = ("act", "failed", "look", "designed", "fine")


@dataclass(frozen=True, kw_only=True)
class Row:
    """A loop's row in the table of results; what was not reached or not asked is None.

    Attributes
    ----------
    loop : str
        Name.
    attention : {"act", "failed", "look", "designed", "fine"}
        What the reader should do; ``designed`` of a loop whose present gains are not known, so that nothing is said of
        them.
    severity : float
        0 to 1. Within ``act``: 1 for an unstable loop, else the share by which a margin is missed, or the part of the
        simulation error that is not noise; within ``look``: the part of (11) that another controller would spare.
    reason : str
        Why, in a sentence.
    area : str
        Part of the plant in which the loop is shown.
    file, u_unit, y_unit : str
        Where the record lies, and its units.
    rows, bad_rows, pieces : int
        Rows of the record, those without a good u and y, uninterrupted stretches used.
    duration_s, sample_time_s : float
        Of the stretches together, and their usual step [s].
    points : int
        Frequency points.
    omega_low_rad_s, omega_high_rad_s : float
        Their range [rad/s].
    G_r, omega_0r_rad_s, omega_d_rad_s : float
        Reduced model (8), or (24) without omega_0r.
    gain, integrators, lags_s, dead_time_s, step, step_s
        The fitted plant, see :class:`PlantFigures`.
    K, Ti_s, Td_s, Tf_s, h2, modulus, phase_deg, delay_margin_s : float
        The designed controller, and its norm (11) and margins on the fitted plant.
    K_now, Ti_now_s, h2_now, modulus_now, phase_now_deg : float
        The controller the loop runs with, likewise.
    stable_now : bool
        Whether that loop is stable on the fitted plant.
    verdict, effects : str
        Of the diagnosis, or of the look at a loop in operation; the effects with their probabilities.
    nominal, retuned, extended, noise_floor : float
        Simulation error on held-out rows over the spread of y.
    sure, what_next : str
        Of a loop in operation: what its finding rests on, and what to do.
    period_s : float
        Of its dominant oscillation [s].
    reversals, chance, error_decrease
        Reversals of the command; the probability that a linear valve looks as faulty; ln of the squared error of
        predictions by the command over that by the best faulty valve.
    band, band_low, band_high, jump, jump_low, jump_high, band_of_range : float
        Band and slip jump of a valve that is named [u unit], with their 95 % intervals, and the band over u's range.
    notes : str
        What was corrected, left out or uncertain.
    """

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)  # of a row that is read again

    loop: str
    attention: Attention
    severity: float = 0.0
    reason: str = ""
    area: str = ""
    file: str = ""
    u_unit: str = ""
    y_unit: str = ""
    rows: int | None = None
    bad_rows: int | None = None
    pieces: int | None = None
    duration_s: float | None = None
    sample_time_s: float | None = None
    points: int | None = None
    omega_low_rad_s: float | None = None
    omega_high_rad_s: float | None = None
    G_r: float | None = None
    omega_0r_rad_s: float | None = None
    omega_d_rad_s: float | None = None
    gain: float | None = None
    integrators: int | None = None
    lags_s: str | None = None
    dead_time_s: float | None = None
    step: str | None = None
    step_s: float | None = None
    K: float | None = None
    Ti_s: float | None = None
    Td_s: float | None = None
    Tf_s: float | None = None
    h2: float | None = None
    modulus: float | None = None
    phase_deg: float | None = None
    delay_margin_s: float | None = None
    K_now: float | None = None
    Ti_now_s: float | None = None
    h2_now: float | None = None
    modulus_now: float | None = None
    phase_now_deg: float | None = None
    stable_now: bool | None = None
    verdict: str | None = None
    effects: str | None = None
    nominal: float | None = None
    retuned: float | None = None
    extended: float | None = None
    noise_floor: float | None = None
    sure: str | None = None
    what_next: str | None = None
    period_s: float | None = None
    reversals: int | None = None
    chance: float | None = None
    error_decrease: float | None = None
    band: float | None = None
    band_low: float | None = None
    band_high: float | None = None
    jump: float | None = None
    jump_low: float | None = None
    jump_high: float | None = None
    band_of_range: float | None = None
    notes: str = ""

    @property
    def order(self) -> tuple[int, float, str]:
        """Key that sorts rows by what needs attention first."""
        return ATTENTION.index(self.attention), -self.severity, self.loop
