"""An RST controller by pole placement, from what a person has."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from autotune.api.plants import as_plant, as_reduced
from autotune.arguments import number
from autotune.errors import DesignError

if TYPE_CHECKING:
    from autotune.design.rst import RST


def rst(plant: Any, *, dominant_rad_s: float, rest_rad_s: float) -> RST:
    """Return the RST controller S u = T r - R y with integral action that places the closed loop's poles.

    Parameters
    ----------
    plant : TransferFunction, model or its file, python-control system
        Strictly proper, of order n, without dead time.
    dominant_rad_s : float
        Distance of the double dominant pole from the imaginary axis [rad/s].
    rest_rad_s : float
        Distance of the poles that nothing else decides [rad/s]; up to n - 1 stable poles of the plant stay where they
        are.

    Returns
    -------
    RST
        ``R``, ``S``, ``T`` in descending powers of s; ``feedback()`` is R/S, ``prefilter()`` T/R, and
        ``law(sample_time_s)`` the difference equations that run. ``at.margins(plant, found)`` takes it as it is.

    Raises
    ------
    DesignError
        Dead time, a plant that is not strictly proper, one with a common factor or a zero at s = 0, or a reduced model:
        a loop that is stable with it need not be with the plant.

    Notes
    -----
    Nothing is optimised and no margin is promised: it is what a PI or PID of :func:`autotune.tune` is compared with.

    References
    ----------
    Le & Mendes 2010, Table II.

    Examples
    --------
    >>> import autotune as at
    >>> ball = at.example("ball")
    >>> placed = at.rst(ball, dominant_rad_s=1.8, rest_rad_s=11.2)
    >>> round(at.margins(ball, placed).crossover_rad_s, 2)
    2.05
    """
    from autotune.design.rst import place_dominant

    if as_reduced(plant) is not None:
        raise DesignError(
            "an RST is not of class (2), so that margins on the reduced model are no guarantee",
            where="rst",
            remedy="place its poles on the plant, or on a model fitted to it",
        )
    wanted = [
        number(value, name=name, where="rst", above=0.0)
        for name, value in (("dominant_rad_s", dominant_rad_s), ("rest_rad_s", rest_rad_s))
    ]
    return place_dominant(as_plant(plant), wanted[0], wanted[1])
