"""To python-control: TransferFunction, StateSpace, FRD."""

from __future__ import annotations

from typing import Any

import numpy as np

from autotune.api.plants import as_plant
from autotune.api.points import as_points
from autotune.api.python_control import python_control
from autotune.controller import DiscreteController, PIDController
from autotune.design.rst import RST
from autotune.identification.closed_loop.state_space import InnovationModel
from autotune.models import TransferFunction

#: Order of the Pade approximation that stands for a dead time.
PADE_ORDER = 5


def to_control(source: Any, *, pade: int = PADE_ORDER) -> Any:
    """Return something as a system of python-control.

    Parameters
    ----------
    source : object
        A plant, a model, a controller or a design becomes a ``TransferFunction`` (an RST its R/S), a closed-loop
        model a ``StateSpace`` with its sample time, points an ``FRD`` that remembers their covariance.
    pade : int
        Order of the Pade approximation of a dead time, which python-control does not have.

    Returns
    -------
    control.TransferFunction, control.StateSpace or control.FRD

    Examples
    --------
    >>> import autotune as at
    >>> bool(at.to_control(at.PI(K=2.0, Ti_s=4.0)).dcgain() > 1e300)
    True
    """
    control = python_control()
    model = getattr(getattr(source, "estimate", None), "model", source)
    if isinstance(model, InnovationModel):
        whole = model.with_delay_as_states()
        return control.ss(whole.A, whole.B, whole.C, whole.D, whole.sample_time_s)
    points = as_points(source)
    if points is not None:
        response = control.frd([point.response for point in points], [point.omega_rad_s for point in points])
        response.measured_points = points  # an FRD knows no covariance: from_control finds it here again
        return response
    part = source.feedback() if isinstance(source, RST) else getattr(source, "controller", source)
    if isinstance(part, DiscreteController):
        size = max(len(part.num), len(part.den))  # ascending powers of q^-1 are descending ones of z, padded alike
        num, den = (np.pad(np.array(c), (0, size - len(c))) for c in (part.num, part.den))
        return control.tf(num, den, part.sample_time_s)
    if not isinstance(part, TransferFunction | PIDController):
        part = as_plant(part)
    rational = part if isinstance(part, TransferFunction) else part.transfer_function()
    system = control.tf(list(rational.num), list(rational.den))
    return system * control.tf(*control.pade(rational.delay_s, pade)) if rational.delay_s else system
