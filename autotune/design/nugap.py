"""nu-gap with its winding condition, stability margin b(C, P), and both frequency by frequency: validation (10).

The nu-gap depends on the units of u and y. With k P and C/k the loop is the same and the figures are those of the
loop's own scaling; k = 1 is the criterion as printed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.controller import Controller
from autotune.design.axis import characteristic_frequencies, turn_along_axis
from autotune.design.loop import ContinuousLoop, Plant, SampledLoop, open_loop, transfer_function_of
from autotune.design.margins import refine_minimum
from autotune.errors import DesignError
from autotune.models import TransferFunction


def chordal_distance(P1: ComplexArray, P2: ComplexArray) -> FloatArray:
    """Return abs(P1 - P2)/sqrt((1 + abs(P1)^2)(1 + abs(P2)^2)), the distance on the Riemann sphere, 0 to 1.

    Parameters
    ----------
    P1, P2 : (N,) complex array
        Two responses at the same frequencies.

    Returns
    -------
    (N,) array
        The distances.
    """
    a1, a2 = np.abs(P1), np.abs(P2)
    # written with reciprocals where the gain is large, so that an integrator does not overflow
    return np.asarray(np.abs(P1 - P2) / (np.hypot(1.0, a1) * np.hypot(1.0, a2)))


def nu_gap(P1: Plant, P2: Plant, *, scaling: float = 1.0) -> float:
    """Return the nu-gap between k P1 and k P2, 0 to 1.

    Parameters
    ----------
    P1, P2 : TransferFunction or Model
        Plants, with any poles.
    scaling : float
        k [input unit per output unit].

    Returns
    -------
    float
        Largest chordal distance over frequency; 1 where the winding condition fails.

    Notes
    -----
    The winding condition asks that no closed loop of P2 with a compensator built on P1 gains an unstable pole: with
    P_i = N_i/M_i in polynomials, wno of N_1~ N_2 + M_1~ M_2 along the imaginary axis must equal (deg M_1 - deg M_2)/2
    half-turns with imaginary-axis poles of the plants counted as unstable; here: the polynomial's zeros in the right
    half plane must number deg M_1. Dead time is exact: the count is done by the argument along the axis.

    References
    ----------
    Vinnicombe 1993; Le & Mendes 2010, equation (10).
    """
    H1, H2 = transfer_function_of(P1), transfer_function_of(P2)
    if not _winding_condition(_scale(H1, scaling), _scale(H2, scaling)):
        return 1.0
    omega = _pair_grid(H1, H2, scaling)

    def f(x: FloatArray) -> FloatArray:
        return -chordal_distance(scaling * H1.response(x), scaling * H2.response(x))

    return -refine_minimum(f, omega, f(omega))[0]


def generalized_stability_margin(plant: Plant, controller: Controller, *, scaling: float = 1.0) -> float:
    """Return b(C/k, k P) = min over omega of abs(1 + P C)/sqrt((1 + abs(k P)^2)(1 + abs(C/k)^2)); 0 if unstable.

    Parameters
    ----------
    plant : Plant
        P, continuous.
    controller : Controller
        C.
    scaling : float
        k [u unit/y unit].

    References
    ----------
    Le & Mendes 2010, equation (10); Vinnicombe 1993.
    """
    loop = open_loop(plant, controller)
    if not loop.is_stable:
        return 0.0
    # integral action alone moves b below every corner: look at the limit too
    omega = np.append(loop.grid[0] * 1e-6, loop.grid)

    def f(x: FloatArray) -> FloatArray:
        return _local_margin(loop, x, scaling)

    return refine_minimum(f, omega, f(omega))[0]


def _local_margin(loop: ContinuousLoop | SampledLoop, omega: FloatArray, scaling: float) -> FloatArray:
    P, C = scaling * loop.plant_response(omega), loop.controller_response(omega) / scaling
    return np.asarray(np.abs(1.0 + P * C) / (np.hypot(1.0, np.abs(P)) * np.hypot(1.0, np.abs(C))))


def loop_scaling(plant: Plant, controller: Controller) -> float:
    """Return the loop's own scaling k = abs(C) at the highest crossover, so that k P and C/k both have gain 1 there.

    Parameters
    ----------
    plant : Plant
        P, continuous.
    controller : Controller
        C.

    Returns
    -------
    float
        k [u unit/y unit].

    Raises
    ------
    DesignError
        The loop has no crossover.
    """
    from autotune.design.margins import phase_and_delay_margin

    loop = open_loop(plant, controller)
    crossover = phase_and_delay_margin(loop, loop.grid, loop.response(loop.grid))[2]
    if math.isnan(crossover):
        raise DesignError("abs(L) is never 1, so the loop has no scaling of its own", where="nu-gap", remedy="give k")
    return float(np.abs(loop.controller_response(np.array([crossover])))[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class Validation:
    """Criterion (10) at one scaling, and frequency by frequency.

    Attributes
    ----------
    scaling : float
        k.
    nu_gap, b_reduced, b_rig : float
        delta_nu(H, H_r), b(C, H_r) and b(C, H).
    omega_rad_s, distance, local_margin : (N,) array
        Chordal distance of k H and k H_r, and the margin of C/k with k H_r, at each frequency.
    """

    scaling: float
    nu_gap: float
    b_reduced: float
    b_rig: float
    omega_rad_s: FloatArray
    distance: FloatArray
    local_margin: FloatArray

    @property
    def holds(self) -> bool:
        """Whether nu-gap < b(C, H_r) <= b(C, H)."""
        return self.nu_gap < self.b_reduced <= self.b_rig

    @property
    def holds_locally(self) -> bool:
        """Whether the distance is below the local margin at every frequency and the winding condition holds.

        This alone proves that C stabilises H; it asks less than the first condition of (10).
        """
        return self.nu_gap < 1.0 and bool(np.all(self.distance < self.local_margin))


def validate(rig: Plant, reduced: Plant, controller: Controller, *, scaling: float = 1.0) -> Validation:
    """Return criterion (10) of the reduced model against the plant it stands for, with the controller.

    Parameters
    ----------
    rig, reduced : TransferFunction or Model
        H and H_r.
    controller : Controller
        C.
    scaling : float
        k; 1 is the criterion as printed, :func:`loop_scaling` the loop's own.

    References
    ----------
    Le & Mendes 2010, equation (10).
    """
    H, H_r = transfer_function_of(rig), transfer_function_of(reduced)
    loop = open_loop(H_r, controller)
    omega = _pair_grid(H, H_r, scaling) if isinstance(loop, ContinuousLoop) else loop.grid
    return Validation(
        scaling=scaling,
        nu_gap=nu_gap(H, H_r, scaling=scaling),
        b_reduced=generalized_stability_margin(H_r, controller, scaling=scaling),
        b_rig=generalized_stability_margin(H, controller, scaling=scaling),
        omega_rad_s=omega,
        distance=chordal_distance(scaling * H.response(omega), scaling * H_r.response(omega)),
        local_margin=_local_margin(loop, omega, scaling),
    )


def _scale(system: TransferFunction, k: float) -> TransferFunction:
    return TransferFunction(num=tuple(k * b for b in system.num), den=system.den, delay_s=system.delay_s)


def _pair_grid(H1: TransferFunction, H2: TransferFunction, k: float) -> FloatArray:
    """Grid of both plants; the loop with a unit gain of k brings in where their scaled gains cross 1."""
    unit = TransferFunction(num=(k,), den=(1.0,))
    return np.union1d(ContinuousLoop(plant=H1, controller=unit).grid, ContinuousLoop(plant=H2, controller=unit).grid)


def _winding_condition(H1: TransferFunction, H2: TransferFunction) -> bool:
    """Whether N_1~ N_2 exp(-s (L_2 - L_1)) + M_1~ M_2, M_1~(s) = M_1(-s), has as many unstable zeros as M_1~.

    wno(1 + P_1~ P_2) + eta(P_1) - eta_0(P_2) - eta~(P_2) = 0, evaluated as the argument of the polynomial form along
    the axis, which needs no indentation around poles on it.
    """
    N1, M1 = _mirror(H1.num), _mirror(H1.den)
    N2, M2 = np.array(H2.num), np.array(H2.den)
    n1, n2 = len(M1) - 1, len(M2) - 1
    lag = H2.delay_s - H1.delay_s
    omega = _pair_grid(H1, H2, 1.0)
    omega = np.concatenate((-omega[::-1], [0.0], omega))
    a = float(np.exp(np.mean(np.log(characteristic_frequencies(H1, H2)))))

    def parts(x: FloatArray) -> ComplexArray:
        s = 1j * x
        crossed = np.polyval(N1, s) * np.polyval(N2, s) * np.exp(-s * lag)
        # M_1~ has n1 zeros to the right, M_2 counts n2 to the left: what is left must not wind
        found = np.array([crossed, np.polyval(M1, s) * np.polyval(M2, s)]) / ((a - s) ** n1 * (a + s) ** n2)
        return np.asarray(found, dtype=np.complex128)

    turned = turn_along_axis(parts, omega)  # none where a zero lies on the axis: the chordal distance is 1 there
    return turned is not None and round(turned / (2.0 * np.pi)) == 0


def _mirror(coefficients: tuple[float, ...]) -> FloatArray:
    """Coefficients of p(-s)."""
    values = np.array(coefficients)
    return np.asarray(values * (-1.0) ** np.arange(len(values) - 1, -1, -1))
