"""Reduced models (8) and (24) of Le & Mendes 2010 under the conditions (5) that make their margins a guarantee.

With C1: |H_r| >= |H| for all omega and C2: arg H_r <= arg H on [0, omega_-135], a controller of class (2) designed on
H_r has at least the same modulus and phase margin on H (Proposition 1).

C2 is held here on [0, omega_-180], which implies (5). On the printed range the phase margin is safe but the modulus
margin is not: the least |1 + L| may lie beyond omega_-135, where a plant with dead time falls below H_r (lags of 3 and
0.0625 s, dead time 0.5 s: 0.641 on H for 0.648 on H_r). Up to omega_-180 suffices: with a controller of phase below 0
the least |1 + L| lies at or before the frequency where arg L = -180 degrees, since beyond it |1 + L| >= 1 - |L|, and
|L| falls. Condition (6) is needed only where |L| is not large: the paper's own PI (T_I = 3 s > 2/omega_d) breaks it at
low frequency, where nothing depends on it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import IdentificationError
from autotune.identification.envelope import (
    Envelope,
    envelope_of_fit,
    envelope_of_points,
    envelope_of_transfer_function,
    require_class_one,
)
from autotune.identification.parametric import PlantFit, fit_plant
from autotune.models import TransferFunction
from autotune.points import LARGEST, SMALLEST, FrequencyPoint

Kind: TypeAlias = Literal["self-regulating", "integrating"]
Conditions: TypeAlias = Literal["regions", "estimates"]

_WHERE = "reduced model"
#: The static gain counts as determined by the points below this relative standard deviation.
_STATIC_GAIN_SD = 0.1
#: and only while the lowest point's gain is above this part of it: beyond, the structure would decide, not the data.
_STATIC_GAIN_PART = 0.5
_PROBABILITY = 0.95
#: Below this probability the points scatter more than their covariances allow.
_CONTRADICTED = 0.01
#: C2 is held until the plant's phase has fallen to this.
_C2_UNTIL = -math.pi
#: An all-pass carries less than half a turn.
_LARGEST_REST = 0.95 * math.pi


@dataclass(frozen=True, kw_only=True)
class ReducedModel:
    """G_r/(1 + s/omega_0r) (omega_d - s)/(omega_d + s), (8), or G_r/s (omega_d - s)/(omega_d + s), (24).

    Attributes
    ----------
    G_r : float
        Gain with the plant's sign: y unit per u unit for (8), per second for (24).
    omega_0r_rad_s : float or None
        Corner of the lag [rad/s]; None for the integrating model (24).
    omega_d_rad_s : float
        All-pass corner that carries the phase [rad/s].
    sd : tuple of float
        Standard deviations of (G_r, omega_0r, omega_d), relative, from the points' covariance; 0 where exact or absent.
    conditions : {"regions", "estimates", "exact"}
        What the conditions (5) were held on: the points' 95 % regions, the point estimates (the paper's way), or a
        transfer function.
    evidence : str
        Why this structure was chosen.
    warnings : tuple of str
        What the reader should know before relying on it.
    plant : TransferFunction or None
        What was reduced: the known plant, or the one fitted to the points; None where it is not known any more.
    points : tuple of FrequencyPoint
        The points that were reduced; empty for a known plant.
    """

    G_r: float
    omega_0r_rad_s: float | None
    omega_d_rad_s: float
    sd: tuple[float, float, float] = (0.0, 0.0, 0.0)
    conditions: Literal["regions", "estimates", "exact"] = "exact"
    evidence: str = ""
    warnings: tuple[str, ...] = ()
    plant: TransferFunction | None = field(default=None, repr=False)
    points: tuple[FrequencyPoint, ...] = field(default=(), repr=False)

    @property
    def integrating(self) -> bool:
        """Whether it is (24)."""
        return self.omega_0r_rad_s is None

    def transfer_function(self) -> TransferFunction:
        """Return the model as a transfer function."""
        lag = (1.0, 0.0) if self.omega_0r_rad_s is None else (1.0 / self.omega_0r_rad_s, 1.0)
        return TransferFunction(
            num=(-self.G_r / self.omega_d_rad_s, self.G_r),
            den=tuple(float(c) for c in np.polymul(lag, (1.0 / self.omega_d_rad_s, 1.0))),
        )

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return the complex gain at the angular frequencies, same shape as ``omega_rad_s``."""
        return self.transfer_function().response(omega_rad_s)


def reduce_transfer_function(plant: TransferFunction) -> ReducedModel:
    """Fit (8) or (24) to a known plant: (9), smallest |G_r| and omega_0r, largest omega_d that (5) allows.

    Parameters
    ----------
    plant : TransferFunction
        Plant of class (1); the number of its integrators decides between (8) and (24).

    Raises
    ------
    IdentificationError
        The plant is outside class (1), or its phase never reaches -135 degrees.

    References
    ----------
    Le & Mendes, CIFA 2010, (5), (8), (9), (24).
    """
    corners = np.abs(np.concatenate([plant.poles, plant.zeros]))
    corners = corners[corners > 1e-12 * max(corners.max(initial=1.0), 1e-300)]
    scales = [*corners, *([1.0 / plant.delay_s] if plant.delay_s > 0.0 else [])]
    if not scales or plant.integrators > 1:
        raise IdentificationError(
            "the plant is not one of lags, at most one integrator, and dead time",
            where=_WHERE,
            remedy="give it such dynamics",
        )
    omega = np.geomspace(1e-4 * min(scales), 1e2 * max(scales), 6000)
    low = plant.response(omega[:1])[0] * (1j if plant.integrators else 1.0)
    sign = 1 if low.real > 0.0 else -1
    envelope = envelope_of_transfer_function(plant, sign, omega)
    reached = np.flatnonzero(envelope.phase_rad <= -0.75 * math.pi)
    if not reached.size:
        raise IdentificationError("its phase never reaches -135 deg", where=_WHERE, remedy="no all-pass is needed here")
    falling = slice(0, int(reached[0]) + 1)
    if np.any(np.diff(envelope.gain) > 1e-9 * envelope.gain[:-1]) or np.any(
        np.diff(envelope.phase_rad[falling]) > 1e-9
    ):
        raise IdentificationError(
            "gain or phase rises with frequency, as those of no plant of lags and dead time do",
            where=_WHERE,
            remedy="design on the plant itself",
        )
    static_gain = None if plant.integrators else abs(float(plant.num[-1] / plant.den[-1]))
    G_r, omega_0r, omega_d = _by_conditions(envelope, static_gain)
    return ReducedModel(
        G_r=sign * G_r,
        omega_0r_rad_s=omega_0r,
        omega_d_rad_s=omega_d,
        evidence=f"the plant has {plant.integrators} integrator(s)",
        plant=plant,
    )


def reduce_points(
    points: Sequence[FrequencyPoint],
    *,
    kind: Kind | None = None,
    conditions: Conditions = "regions",
    static_gain: tuple[float, float] | None = None,
    fit: PlantFit | None = None,
) -> ReducedModel:
    """Fit (8) or (24) to measured points, so that (5) holds on what the points and their uncertainty allow.

    Parameters
    ----------
    points : sequence of FrequencyPoint
        At least three, spanning -135 degrees.
    kind : {"self-regulating", "integrating"}, optional
        Structure; chosen from the data when absent.
    conditions : {"regions", "estimates"}
        ``regions``: at each point over its 95 % region, and at, between and below the points over the 95 % band of
        the plants (lags, integrator, dead time) that fit all of them; over the band alone, with a warning, where
        single points are too uncertain to bound the phase.
        ``estimates``: at the point estimates only, as the paper does: nothing is said below the lowest point.
    static_gain : (float, float), optional
        Measured static gain with its sign, and its standard deviation: a relay experiment does not measure it.
    fit : PlantFit, optional
        Of these points by :func:`fit_plant`, where it is there already; not used with a static gain.

    Returns
    -------
    ReducedModel
        With the plant's sign in G_r.

    Raises
    ------
    IdentificationError
        Too few points, points outside class (1), none near -135 degrees, or a self-regulating model asked for whose
        static gain the points do not determine.

    Notes
    -----
    (24) is admissible for a self-regulating plant too, since G_r/omega bounds any lag: it is taken whenever the points
    do not determine the static gain, at the price of conservatism at low frequency. The regions' extremes are to
    first order. Above the highest point the plant is taken to roll off at least as 1/omega.

    References
    ----------
    Le & Mendes, CIFA 2010, (1), (5), (8), (9), (24).
    """
    ordered = sorted(points, key=lambda point: point.omega_rad_s)
    fitted = ordered if static_gain is None else [_static_point(ordered, static_gain), *ordered]
    if fit is None or static_gain is not None:
        fit = fit_plant(fitted)
    require_class_one(ordered, fit.sign)
    chosen, evidence, warnings = _choose(fitted, fit, kind)
    if conditions == "regions":
        _require_135(ordered, fit)
    gain = abs(fit.plant.num[0]) if chosen == "self-regulating" else None
    envelope, (G_r, omega_0r, omega_d), more = _reduce(ordered, fit, conditions, gain)
    warnings = (*warnings, *more)
    if fit.p_value < _CONTRADICTED:
        warnings = (
            *warnings,
            f"the points scatter more than their regions say (p = {fit.p_value:.1g}); the regions between them"
            " are widened accordingly",
        )
    return ReducedModel(
        G_r=fit.sign * G_r,
        omega_0r_rad_s=omega_0r,
        omega_d_rad_s=omega_d,
        sd=_spread(fit.draws(200, np.random.default_rng(1)), fit, envelope.omega_rad_s, chosen),
        conditions=conditions,
        evidence=evidence,
        warnings=warnings,
        plant=fit.plant,
        points=tuple(ordered),
    )


def _bounds_of(points: Sequence[FrequencyPoint], fit: PlantFit, conditions: Conditions) -> Envelope:
    if conditions == "estimates":
        return envelope_of_points(points, fit.sign, 0.0)
    grid = np.geomspace(1e-3 * points[0].omega_rad_s, 3.0 * points[-1].omega_rad_s, 400)
    return envelope_of_fit(fit, grid, _PROBABILITY)


def _reduce(
    points: Sequence[FrequencyPoint], fit: PlantFit, conditions: Conditions, gain: float | None
) -> tuple[Envelope, tuple[float, float | None, float], tuple[str, ...]]:
    """Return the bounds used, (|G_r|, omega_0r, omega_d), and what to warn of."""
    known = _bounds_of(points, fit, conditions)
    if conditions == "estimates":
        return known, _by_conditions(known, gain), ()
    # the structure chosen for the fit is itself uncertain: each point's own region stands beside the band
    both = envelope_of_points(points, fit.sign, _PROBABILITY).join_with(known)
    try:
        return both, _by_conditions(both, gain, static_gain_known=False), ()
    except IdentificationError:
        warning = (
            "single points are too uncertain to bound the phase: the reduced model bounds the band of the plants that"
            " fit all of them, if the plant is one of lags, integrator and dead time"
        )
        return known, _by_conditions(known, gain, static_gain_known=False), (warning,)


def _choose(fitted: Sequence[FrequencyPoint], fit: PlantFit, kind: Kind | None) -> tuple[Kind, str, tuple[str, ...]]:
    """Return the structure, why, and what to warn of."""
    static_sd = _static_sd(fit, fitted)
    if kind == "self-regulating" and (fit.integrating or static_sd > _STATIC_GAIN_SD):
        found = "integrate" if fit.integrating else _open_gain(static_sd)
        raise IdentificationError(
            f"the points {found}: gain G_r and lag omega_0r are not determined by them",
            where=_WHERE,
            remedy="measure the static gain (two steady states) and give it, or use the integrating model",
        )
    if kind is not None:
        return kind, "asked for", ()
    if fit.integrating:
        return "integrating", "an integrator with lags and dead time explains the points best", ()
    if static_sd <= _STATIC_GAIN_SD:
        return "self-regulating", f"the points determine the static gain to {100 * static_sd:.2g} %", ()
    return (
        "integrating",
        f"self-regulating, but the points {_open_gain(static_sd)}",
        ("(24) is more cautious than (8) at low frequency; a measured static gain would win that back",),
    )


def _open_gain(static_sd: float) -> str:
    if math.isinf(static_sd):
        return "do not reach down to the static gain"
    return f"leave the static gain open by {100 * static_sd:.0f} %"


def _static_sd(fit: PlantFit, points: Sequence[FrequencyPoint]) -> float:
    """Return the relative standard deviation of the static gain; infinite where the data do not reach down to it."""
    if fit.integrating or points[0].gain < _STATIC_GAIN_PART * abs(fit.plant.num[0]):
        return math.inf
    return math.sqrt(float(fit.covariance[0, 0]))


def _static_point(points: Sequence[FrequencyPoint], static_gain: tuple[float, float]) -> FrequencyPoint:
    value, sd = static_gain
    if not (SMALLEST <= abs(value) <= LARGEST and 1e-9 * abs(value) <= sd <= LARGEST):
        raise IdentificationError(
            f"static gain {value:g} with standard deviation {sd:g}", where=_WHERE,
            remedy="give a gain other than 0, known to no more than nine digits",
        )  # fmt: skip
    return FrequencyPoint(
        omega_rad_s=1e-6 * points[0].omega_rad_s,
        response=complex(value, 0.0),
        covariance=((sd**2, 0.0), (0.0, (1e-4 * value) ** 2)),
        source="static",
    )


def _require_135(points: Sequence[FrequencyPoint], fit: PlantFit) -> None:
    top = 1.5 * points[-1].omega_rad_s
    phase = np.unwrap(np.angle(fit.sign * fit.plant.response(np.geomspace(1e-3 * points[0].omega_rad_s, top, 400))))
    if phase[-1] > -0.75 * math.pi:
        raise IdentificationError(
            f"the points end at {points[-1].omega_rad_s:.4g} rad/s, well before the phase reaches -135 deg",
            where=_WHERE,
            remedy="measure a point at a higher frequency (less inserted delay)",
        )


def _by_conditions(
    envelope: Envelope, static_gain: float | None, *, static_gain_known: bool = True
) -> tuple[float, float | None, float]:
    """Return |G_r|, omega_0r and omega_d by (9): each the tightest that (5) allows."""
    omega_0r: float | None
    omega, gain = envelope.omega_rad_s, envelope.gain
    if static_gain is None:
        G_r, omega_0r = float(np.max(omega * gain)), None  # C1 on (24): |G_r| >= omega |H|
        lag = np.full(omega.size, 0.5 * math.pi)
    else:
        G_r, omega_0r = _lag(envelope, static_gain, static_gain_known)
        lag = np.arctan(omega / omega_0r)
    rest = -envelope.phase_rad - lag  # what the all-pass must carry: 2 atan(omega/omega_d) >= rest
    use = envelope.until_phase(_C2_UNTIL)
    if np.max(rest[use]) >= _LARGEST_REST and static_gain_known:
        raise IdentificationError(
            "the dead time is so long beside the lags that no all-pass bounds the phase up to -180 deg, without which"
            " the modulus margin is not guaranteed",
            where=_WHERE,
            remedy="design on the plant itself",
        )
    if (
        np.max(rest[use]) >= _LARGEST_REST
    ):  # so uncertain that no all-pass reaches: the printed range then, with a check
        use = envelope.until_phase(-0.75 * math.pi)
    if not np.any(rest[use] > 1e-12):
        raise IdentificationError(
            "the phase never falls below that of the lag alone: omega_d is not determined",
            where=_WHERE,
            remedy="measure points at higher frequencies",
        )
    if np.max(rest[use]) >= _LARGEST_REST:
        raise IdentificationError(
            "the phase near -135 deg is known too poorly for an all-pass to bound it",
            where=_WHERE,
            remedy="measure that range with more amplitude or for longer",
        )
    inverse = np.tan(0.5 * np.maximum(rest[use], 0.0)) / omega[use]
    return G_r, omega_0r, float(1.0 / np.max(inverse))


def _lag(envelope: Envelope, static_gain: float, known: bool) -> tuple[float, float]:
    """Return |G_r| and omega_0r of (8) under C1: omega_0r^2 >= omega^2 / (G_r^2/|H|^2 - 1).

    Where the static gain is known, G_r is that, as in (9). Where |H| is an upper bound with a margin at every
    frequency, G_r at that bound would ask for a corner far too high; the pair with the least excess, low-frequency and
    high-frequency asymptote together, is taken instead.
    """
    least = max(static_gain, float(np.max(envelope.gain)))
    pairs = []
    for G_r in (least,) if known else least * np.linspace(1.0, 1.5, 101)[1:]:
        ratio = (G_r / envelope.gain) ** 2 - 1.0
        some = ratio > 1e-8
        if not some.any():
            raise IdentificationError("the gain does not fall", where=_WHERE, remedy="measure at higher frequencies")
        pairs.append((float(G_r), float(np.max(envelope.omega_rad_s[some] / np.sqrt(ratio[some])))))
    return min(pairs, key=lambda pair: pair[0] ** 2 * pair[1])


def _spread(
    plants: Sequence[TransferFunction], fit: PlantFit, omega: FloatArray, kind: Kind
) -> tuple[float, float, float]:
    """Return the relative standard deviations of (G_r, omega_0r, omega_d) over plants that fit the points."""
    rows = []
    for plant in plants:
        gain = abs(plant.num[0]) if kind == "self-regulating" else None
        try:
            rows.append(_by_conditions(envelope_of_transfer_function(plant, fit.sign, omega), gain))
        except IdentificationError:  # a draw without lag beyond the first: it bounds nothing
            continue
    if len(rows) < 2:
        return (0.0, 0.0, 0.0)
    values = np.array([[row[0], row[1] or 1.0, row[2]] for row in rows])
    sd = np.std(values, axis=0) / np.mean(values, axis=0)
    return (float(sd[0]), float(sd[1]), float(sd[2]))
