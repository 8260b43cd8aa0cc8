"""The control law recomputed: whether the recorded u follows from r and y by the stated law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from autotune.arrays import FloatArray
from autotune.controller import Controller, PIDController
from autotune.diagnosis.samples import SampleEffect
from autotune.models import Parameter
from autotune.recording import Recording

#: A gain or integral time this far from the stated one, in standard deviations, is a broken law.
SIGMAS = 6.0
LEAST_CHANGE = 0.04


def law_effect(recordings: Sequence[Recording], controller: Controller | None = None) -> SampleEffect | None:
    """Return the mismatch of the control law where u recomputed from r and y differs from the recorded u.

    Parameters
    ----------
    recordings : sequence of Recording
        Those with a set-point column ``r`` are looked at.
    controller : Controller, optional
        The stated law; the sidecar's ``[controller]`` with ``K`` and ``T_I`` by default.

    Returns
    -------
    SampleEffect or None
        ``controller.law`` with the gain and the integral time that the recordings show, as factors of the stated.

    Notes
    -----
    u = bias + K (e + integral(e)/T_I) + dither, the dither unknown: K and K/T_I are estimated by least squares with
    coloured noise (differences of u and of the regressors), and compared with what is stated.
    """
    for r in recordings:
        stated = stated_law(r.metadata, controller)
        if stated is None or "r" not in r.extra or not np.all(np.isfinite(r["r"])):
            continue
        if np.ptp(r.u) == 0.0:
            continue  # a command that stands at its limit tells nothing of the law
        K, Ti = stated
        estimate, covariance = fitted_law(r)
        names = ["gain_factor"] + (["T_I_factor"] if np.isfinite(Ti) else [])
        aims = np.array([K, K / Ti])[: len(names)]
        if np.any(aims == 0.0):
            continue
        ratio = estimate[: len(names)] / aims
        sd = np.sqrt(np.diag(covariance))[: len(names)] / np.abs(aims)
        off = np.abs(ratio - 1.0)
        if np.any((off > SIGMAS * sd) & (off > LEAST_CHANGE)):
            values = {"gain_factor": Parameter(value=float(ratio[0]), sd=float(sd[0]), unit="-")}
            if len(names) > 1:
                factor = float(ratio[0] / ratio[1])
                values["T_I_factor"] = Parameter(value=factor, sd=float(factor * np.hypot(sd[0], sd[1])), unit="-")
            return SampleEffect(
                name="controller.law",
                equation="u = bias + K (e + integral(e)/T_I) with K and T_I other than stated",
                parameters=values,
                evidence=float(np.max((off / sd) ** 2)),
            )
    return None


def stated_law(metadata: Mapping[str, Any], controller: Controller | None) -> tuple[float, float] | None:
    """Return K and T_I of the PI law that the user or the sidecar states, nothing where it is another or none."""
    if isinstance(controller, PIDController):
        return (controller.K, controller.Ti_s) if controller.Td_s == 0.0 and controller.Tf_s == 0.0 else None
    given = metadata.get("controller", {})
    if not isinstance(given, Mapping) or str(given.get("kind", "")).upper() not in ("PI", "P"):
        return None
    if "K" not in given:
        return None
    Ti = float(given.get("T_I", given.get("Ti_s", np.inf)) or np.inf)
    return float(given["K"]), Ti


def fitted_law(r: Recording) -> tuple[FloatArray, FloatArray]:
    """Return K and K/T_I with their covariance, the dither's colour taken for an AR(8) noise.

    A row's command may follow from that row's sample or, where command and sample are exchanged at one instant, from
    the one before: the rows themselves say which, by what they leave unexplained.
    """
    e = np.nan_to_num(r["r"] - r.y)
    at_once = _law_of(r.t, r.u, e)
    one_before = _law_of(r.t[1:], r.u[1:], e[:-1])
    return min(at_once, one_before, key=lambda found: found[2])[:2]


def _law_of(t: FloatArray, u: FloatArray, e: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return K, K/T_I and bias, their covariance, and the variance left, of commands from errors row by row."""
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (e[1:] + e[:-1]) * np.diff(t))])
    X = np.column_stack([e, integral, np.ones(e.size)])
    weights = np.linalg.lstsq(X, u, rcond=None)[0]
    for _ in range(3):
        residual = u - X @ weights
        filtered = _prewhitening(residual)
        Xw = np.column_stack([np.convolve(column, filtered)[: e.size] for column in X.T])[filtered.size :]
        uw = np.convolve(u, filtered)[: e.size][filtered.size :]
        weights = np.linalg.lstsq(Xw, uw, rcond=None)[0]
    left = uw - Xw @ weights
    variance = float(left @ left) / max(left.size - 3, 1)
    return weights, np.linalg.pinv(Xw.T @ Xw) * variance, variance


def _prewhitening(residual: FloatArray, order: int = 8) -> FloatArray:
    """Return 1, -a1, ..., the filter that whitens a residual, by least squares."""
    past = np.column_stack([residual[order - k - 1 : residual.size - k - 1] for k in range(order)])
    a = np.linalg.lstsq(past, residual[order:], rcond=1e-10)[0]
    return np.concatenate([[1.0], -a])
