"""Was the loop excited enough to say what the plant is, and what would be enough."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import IdentificationError
from autotune.identification.closed_loop.lagged import triangle
from autotune.identification.closed_loop.subspace_direct import LaggedData

#: Relative standard deviation of the response that a design can live with.
PRECISION_WANTED = 0.05
#: Part of u's standard deviation that past u and y leave open, below which nothing but the feedback moved it: ten
#: times the trace of noise that the lagged data suppose, and the resolution of a recording's digits.
_FEEDBACK_ALONE = 3e-5


@dataclass(frozen=True, kw_only=True)
class ExcitationVerdict:
    """How precisely the recording shows the plant where a controller needs it.

    Attributes
    ----------
    enough : bool
        Whether the response is known to 5 % (standard deviation) throughout the band.
    band_rad_s : (float, float)
        Band that was judged, an octave either side of the critical frequency [rad/s].
    critical : str
        What that frequency is.
    relative_sd : float
        Largest standard deviation of the response in the band, relative to its magnitude.
    own_motion : float
        Standard deviation of u that past u and y do not explain, relative to u's.
    amplitude_factor, length_factor : float
        The same excitation this much larger, or the record this much longer, would reach 5 %; 1 where it is reached.
    sentence : str
        The verdict for a reader.
    """

    enough: bool
    band_rad_s: tuple[float, float]
    critical: str
    relative_sd: float
    own_motion: float
    amplitude_factor: float
    length_factor: float
    sentence: str


def own_motion(data: LaggedData) -> float:
    """Return the part of u's standard deviation that past u and y, and the present y, do not explain.

    Parameters
    ----------
    data : LaggedData
        Triangular factor of past and present.

    Returns
    -------
    float
        0 to 1, the smallest over the inputs: 0 where u is a fixed linear function of what was measured.
    """
    now_u, now_y = data.now
    past = data.past().stop
    turned = triangle(data.R[:, np.r_[0:past, now_y.start : now_y.stop, now_u.start : now_u.stop]])
    left = np.abs(np.diag(turned))[-data.n_u :]
    total = np.linalg.norm(data.R[:, now_u], axis=0)
    return float(np.min(left / np.where(total > 0, total, np.inf)))


def require_excitation(motion: float, *, r_recorded: bool, r_moves: bool, where: str = "") -> None:
    """Refuse a recording in which nothing but the feedback moved the command.

    Parameters
    ----------
    motion : float
        Share of u's motion that does not follow from past u and y.
    r_recorded, r_moves : bool
        Whether there is a set-point, and whether it moved.
    where : str
        Names the recording in the message.

    Raises
    ------
    IdentificationError
        Says whether r is missing or did not move.
    """
    if motion > _FEEDBACK_ALONE or r_moves:
        return
    reason = "r was recorded and did not move" if r_recorded else "r was not recorded"
    raise IdentificationError(
        f"u is not persistently exciting: it follows from past u and y alone (all but {motion:.1e} of it), "
        f"and {reason}, so plant and inverse controller cannot be told apart",
        where=where,
        remedy="move the set-point or add a dither to the command while recording",
    )


def critical_frequency(
    omega_rad_s: FloatArray, plant: ComplexArray, controller: ComplexArray | None
) -> tuple[float, str]:
    """Return the frequency the loop is judged at, and what it is.

    Parameters
    ----------
    omega_rad_s : (W,) array
        Ascending grid [rad/s].
    plant, controller : (W,) arrays
        Responses; without a controller the plant's phase decides.

    Returns
    -------
    omega : float
        Last gain crossover of the loop; without a controller the first frequency at which the plant's phase (its
        static sign taken off) has fallen to -135 deg, or the middle of the grid.
    what : str
    """
    if controller is not None:
        above = np.abs(plant * controller) >= 1.0
        crossings = np.flatnonzero(above[:-1] & ~above[1:])
        if len(crossings):
            return float(omega_rad_s[crossings[-1]]), "gain crossover"
    phase = np.unwrap(np.angle(plant))
    start = phase[0] - math.pi * round((phase[0] + math.pi / 4) / math.pi)  # between -135 and 45 deg
    fallen = np.flatnonzero(phase - phase[0] + start <= -0.75 * math.pi)
    if len(fallen):
        return float(omega_rad_s[fallen[0]]), "phase of -135 deg"
    return float(np.sqrt(omega_rad_s[0] * omega_rad_s[-1])), "middle of the band"


def judge(
    omega_rad_s: FloatArray,
    plant: ComplexArray,
    covariance: FloatArray,
    *,
    controller: ComplexArray | None,
    motion: float,
) -> ExcitationVerdict:
    """Judge the precision in the band where a controller needs the plant.

    Parameters
    ----------
    omega_rad_s : (W,) array
        Grid [rad/s].
    plant : (W,) array
        Estimated response.
    covariance : (W, 2, 2) array
        Of (re, im).
    controller : (W,) array or None
        Response of the present controller.
    motion : float
        From :func:`own_motion`.
    """
    omega, critical = critical_frequency(omega_rad_s, plant, controller)
    band = (max(omega / 2.0, float(omega_rad_s[0])), min(omega * 2.0, float(omega_rad_s[-1])))
    inside = (omega_rad_s >= band[0]) & (omega_rad_s <= band[1])
    relative = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2.0) / np.abs(plant)
    worst = float(np.max(relative[inside], initial=0.0))
    factor = max(1.0, worst / PRECISION_WANTED)
    enough = worst <= PRECISION_WANTED
    where = f"{band[0]:.3g} to {band[1]:.3g} rad/s (an octave around the {critical}, {omega:.3g} rad/s)"
    sentence = f"the plant is known to {100 * worst:.2g} % (standard deviation) from {where}"
    if enough:
        sentence = f"excited enough: {sentence}"
    else:
        sentence = (
            f"not excited enough: {sentence}; {100 * PRECISION_WANTED:g} % would need the same excitation "
            f"{_times(factor)} times as large, or the record {_times(factor**2)} times as long"
        )
    return ExcitationVerdict(
        enough=enough,
        band_rad_s=band,
        critical=critical,
        relative_sd=worst,
        own_motion=motion,
        amplitude_factor=factor,
        length_factor=factor**2,
        sentence=sentence,
    )


def _times(factor: float) -> str:
    return f"{factor:.2g}" if factor < 100.0 else f"{factor:.0f}"
