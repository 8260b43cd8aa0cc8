"""Gains that no rig of these ranges runs with, whatever its plant is."""

from __future__ import annotations

from autotune.config.procedure import LimitSettings

#: Of y's range, the error that moves the command through its whole range by K alone, and within one sample by K/T_I.
#: No reading resolves a millionth of its range, and no limits of y are a hundred times as wide as what u can reach.
LEAST_BAND, LEAST_INTEGRATED = 1e-6, 1e-2


def beyond_ranges(K: float, Ti_s: float, limits: LimitSettings, sample_time_s: float) -> str | None:
    """Return in a sentence how gains are beyond what a rig's ranges can mean, or None where they are not.

    Parameters
    ----------
    K : float
        Proportional gain [u unit/y unit].
    Ti_s : float
        Integral time [s]; infinite for none.
    limits : LimitSettings
        Ranges of command and measurement.
    sample_time_s : float
        Of the loop [s].

    Notes
    -----
    Wide: a gain that makes this plant's loop unstable may pass. What is known of the plant says more.
    """
    u_range, y_range = limits.u_max - limits.u_min, limits.y_max - limits.y_min
    for name, gain, least, within in (
        (f"K = {K:.4g}", abs(K), LEAST_BAND, ""),
        (f"K / T_I = {K / Ti_s:.4g} per s", abs(K) * sample_time_s / Ti_s, LEAST_INTEGRATED, " within one sample"),
    ):
        if gain * least * y_range > u_range:
            return (
                f"{name} moves the command through its whole range, {u_range:g},{within} for an error of"
                f" {u_range / gain:.2g}, where y may be anywhere within {y_range:g}"
            )
    return None
