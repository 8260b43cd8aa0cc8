"""From python-control: TransferFunction, StateSpace, FRD."""

from __future__ import annotations

from typing import Any

import numpy as np

from autotune.api.points import Points
from autotune.arrays import ComplexArray, FloatArray
from autotune.controller import DiscreteController
from autotune.errors import InputError
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.models import TransferFunction
from autotune.points import FrequencyPoint


def from_control(
    system: Any, *, delay_s: float = 0.0
) -> TransferFunction | DiscreteController | Points | InnovationModel:
    """Return a system of python-control as this project's own.

    Parameters
    ----------
    system : control.TransferFunction, control.StateSpace or control.FRD
        One input and one output; a ``StateSpace`` in discrete time may have several.
    delay_s : float
        Dead time besides [s], for a system in continuous time.

    Returns
    -------
    TransferFunction
        Of a system in continuous time.
    DiscreteController
        Of a discrete ``TransferFunction``, in ascending powers of the delay operator.
    InnovationModel
        Of a discrete ``StateSpace``, without a noise model.
    Points
        Of an ``FRD``: those that :func:`autotune.to_control` made it of, else with a standard deviation of a thousandth
        of each gain, which is in their ``notes``.

    Examples
    --------
    >>> import control
    >>> import autotune as at
    >>> at.from_control(control.tf([2], [3, 1]), delay_s=0.5)
    TransferFunction(num=(2.0,), den=(3.0, 1.0), delay_s=0.5)
    """
    control = python_control()
    if isinstance(system, control.FrequencyResponseData):
        return _points(np.asarray(system.omega), np.asarray(system.frdata)[0, 0], system)
    if not hasattr(system, "dt"):
        raise InputError(
            f"a {type(system).__name__} is no system of python-control",
            where="from_control",
            remedy="give a TransferFunction, a StateSpace or an FRD of it",
        )
    discrete = bool(system.dt)
    if discrete and isinstance(system, control.StateSpace):
        n_y = system.C.shape[0]
        return InnovationModel(
            A=np.asarray(system.A), B=np.asarray(system.B), C=np.asarray(system.C), D=np.asarray(system.D),
            K=np.zeros((system.A.shape[0], n_y)), innovation_covariance=np.zeros((n_y, n_y)),
            sample_time_s=float(system.dt),
        )  # fmt: skip
    if system.ninputs != 1 or system.noutputs != 1:
        raise InputError(
            f"{system.ninputs} inputs and {system.noutputs} outputs", where="from_control", remedy="give one of each"
        )
    rational = control.tf(system)
    num, den = np.asarray(rational.num[0][0], dtype=np.float64), np.asarray(rational.den[0][0], dtype=np.float64)
    # leading coefficients that the way from a state space left at rounding would be zeros far to the right
    num = num[int(np.argmax(np.abs(num) > 1e-12 * np.max(np.abs(num)))) :]
    if not discrete:
        return TransferFunction(num=tuple(map(float, num)), den=tuple(map(float, den)), delay_s=delay_s)
    late = np.concatenate([np.zeros(len(den) - len(num)), num])
    return DiscreteController(
        num=tuple(map(float, late / den[0])), den=tuple(map(float, den / den[0])), sample_time_s=float(system.dt)
    )


def _points(omega: FloatArray, response: ComplexArray, system: Any) -> Points:
    measured = getattr(system, "measured_points", ())
    same = [(point.omega_rad_s, point.response) for point in measured] == list(zip(omega, response, strict=True))
    if measured and same:
        return Points(measured, measured.notes)
    return Points(
        (_known_point(float(w), complex(g)) for w, g in zip(omega, response, strict=True)),
        ["an FRD has no covariance: a thousandth of each gain is taken for its standard deviation"],
    )


def _known_point(omega: float, gain: complex) -> FrequencyPoint:
    variance = (1e-3 * abs(gain)) ** 2
    return FrequencyPoint(
        omega_rad_s=omega, response=gain, covariance=((variance, 0.0), (0.0, variance)), source="python-control"
    )


def python_control() -> Any:
    """Return the package python-control.

    Raises
    ------
    InputError
        It is not installed.
    """
    try:
        import control
    except ImportError:
        raise InputError(
            "python-control is not installed", where="control", remedy="pip install 'relay-autotune[control]'"
        ) from None
    return control
