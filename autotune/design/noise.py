"""How much measurement noise a controller may pass on to the command, where nobody says so: from what was measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import FloatArray
from autotune.design.axis import characteristic_frequencies, corner_frequencies
from autotune.models import TransferFunction

#: noise on the command [standard deviation] as a share of the command's range, from u_min to u_max
SHARE_OF_RANGE = 0.01
#: and as a share of the span that the command moved over, where only a recording is known: tests move a tenth of it
SHARE_OF_SPAN = 0.1
#: largest noise gain over the inverse of the plant's gain where its phase is -135 degrees: a PI needs a tenth of it
LARGEST = 10.0


@dataclass(frozen=True, kw_only=True)
class LoopFacts:
    """What is known of a loop besides its plant; None where it is not.

    Attributes
    ----------
    noise_sd : float or None
        Standard deviation of the measurement's noise [y unit].
    u_range : float or None
        Range of the command [u unit].
    u_span : float or None
        Span that the command moved over in the recording [u unit].
    sample_time_s : float or None
        Sample time of the loop [s].
    """

    noise_sd: float | None = None
    u_range: float | None = None
    u_span: float | None = None
    sample_time_s: float | None = None


def default_noise_gain(
    plant: TransferFunction, facts: LoopFacts, highest_rad_s: float | None = None
) -> tuple[float, str]:
    """Return the noise gain N_max [u unit/y unit] of (15), and where it comes from.

    Parameters
    ----------
    plant : TransferFunction
        Fitted plant.
    facts : LoopFacts
        Noise and range of the command.
    highest_rad_s : float, optional
        Highest frequency that is known of the plant [rad/s]; ten times its fastest corner when absent.

    Notes
    -----
    The noise that is left on the command may have a standard deviation of 1 % of its range, or of a tenth of the span
    of a test where the range is not known. Without noise, or for a plant so slow that it would not matter, the limit is
    ten times what the plant's gain at -135 degrees, or at the highest known frequency, lets a PI use.
    """
    if highest_rad_s is None:
        highest_rad_s = 10.0 * float(max(corner_frequencies(plant), default=characteristic_frequencies(plant)[-1]))
    omega = np.geomspace(1e-4 * highest_rad_s, highest_rad_s, 800)
    response = plant.response(omega)
    turned = np.abs(np.unwrap(np.angle(response)) - np.angle(response[0]))
    start = 0.5 * math.pi if plant.integrators else 0.0
    beyond = np.flatnonzero(turned + start >= 0.75 * math.pi)
    at = int(beyond[0]) if beyond.size else omega.size - 1
    most = LARGEST / float(np.abs(response[at]))
    allowed, words = math.inf, ""
    if facts.noise_sd is not None and facts.noise_sd > 0.0:
        if facts.u_range is not None:
            allowed = SHARE_OF_RANGE * facts.u_range / facts.noise_sd
            words = f"{100 * SHARE_OF_RANGE:g} % of the command's range over the measured noise"
        elif facts.u_span is not None:
            allowed = SHARE_OF_SPAN * facts.u_span / facts.noise_sd
            words = f"{100 * SHARE_OF_SPAN:g} % of the span that u moved over, over the measured noise"
    if allowed <= most:
        return allowed, words
    return most, f"{LARGEST:g} over the plant's gain at {omega[at]:.3g} rad/s" + (
        ", as the noise allows more" if words else "; no noise is known"
    )


def noise_of(y: FloatArray) -> float:
    """Return the standard deviation of the noise of rows of y, from second differences and the resolution.

    What moves slowly against the rows is not in second differences, and a median is not moved by bumps. Noise that is
    slow against the rows is not seen; the command hardly amplifies it.
    """
    y = y[np.isfinite(y)]
    if y.size < 5:
        return 0.0
    second = np.diff(y, 2)
    robust = float(np.median(np.abs(second))) / 0.6745 / math.sqrt(6.0)
    steps = np.abs(np.diff(y))
    steps = steps[steps > 0.0]
    resolution = float(np.min(steps)) / math.sqrt(12.0) if steps.size else 0.0
    return max(robust, resolution)
