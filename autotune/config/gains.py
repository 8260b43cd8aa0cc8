"""Gains that no rig of these ranges runs with, whatever its plant is."""

from __future__ import annotations

from autotune.config.procedure import LimitSettings

#: Of y's range, the error that moves the command through its whole range by K alone: no reading resolves a millionth.
LEAST_BAND = 1e-6
#: Of the swing that y may have, the error that moves it so within one sample by K/T_I: a loop of which that is true
#: switches, and no swing is ten times as wide as what u can reach.
LEAST_INTEGRATED = 0.1


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
    u_range, y_range, swing = limits.u_max - limits.u_min, limits.y_max - limits.y_min, limits.swing
    moves = f"moves the command through its whole range, {u_range:g},"
    if abs(K) * LEAST_BAND * y_range > u_range:
        return f"K = {K:.4g} {moves} for an error of {u_range / abs(K):.2g}, where y may be anywhere within {y_range:g}"
    integrated = abs(K) * sample_time_s / Ti_s if Ti_s > 0.0 else 0.0
    if integrated * LEAST_INTEGRATED * swing > u_range:
        return (
            f"K / T_I = {K / Ti_s:.4g} per s {moves} within one sample for an error of {u_range / integrated:.2g},"
            f" where y may swing by {swing:g}"
        )
    return None
