"""Points of the frequency response, as a tuple that shows, converts and plots itself."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

from autotune.api.recordings import Source, read, recordings
from autotune.arguments import number, settings_of
from autotune.errors import InputError
from autotune.points import FrequencyPoint, read_points


class Points(tuple[FrequencyPoint, ...]):
    """Frequency points in ascending order; every function of the project takes it for the tuple that it is.

    Attributes
    ----------
    notes : tuple of str
        What was found out on the way.
    """

    notes: tuple[str, ...]

    def __new__(cls, points: Iterable[FrequencyPoint], notes: Iterable[str] = ()) -> Points:
        """Return the points sorted by frequency."""
        points = list(points) if isinstance(points, Iterable) else [points]
        if not all(isinstance(point, FrequencyPoint) for point in points) or not isinstance(notes, Iterable):
            raise InputError("not all of these are points", where="Points", remedy="give FrequencyPoint objects")
        made = super().__new__(cls, sorted(points, key=lambda point: point.omega_rad_s))
        made.notes = tuple(notes)
        return made

    def __repr__(self) -> str:
        band = f", {self[0].omega_rad_s:.4g} to {self[-1].omega_rad_s:.4g} rad/s" if self else ""
        return f"<{len(self)} frequency points{band}>"


def frequency_points(source: Source, *, largest_relative_sd: float = 0.5, **names: str) -> Points:
    """Return points of the frequency response with their covariance, from recordings of any excitation.

    Parameters
    ----------
    source : recording, path, DataFrame, list of these, or a points file
        Relay, multisine, random binary or steps, in open loop or closed loop; the kind is found out. Several are
        merged by their covariance. A path that ends in .json is a file of points.
    largest_relative_sd : float
        Points less certain than this share of their gain are left out.
    **names : str
        Columns, as in :func:`autotune.read`.

    Returns
    -------
    Points

    Raises
    ------
    IdentificationError
        The recordings move too little, or y does not answer u beyond chance.

    Examples
    --------
    >>> import autotune as at
    >>> points = at.frequency_points(at.example("oven"))
    >>> at.plot(points)                                                       # doctest: +SKIP
    >>> float(abs(points[0].response) / 2.0) > 0.9
    True
    """
    from autotune.identification.frequency.recorded import combine, session_points, sessions

    largest_relative_sd = number(largest_relative_sd, name="largest_relative_sd", where="frequency_points", above=0.0)
    if isinstance(source, str | os.PathLike) and os.fspath(source).endswith(".json"):
        return Points(read_points(source))
    names = settings_of(read, names, where="frequency_points")
    data = sessions(recordings(source, **names))
    combined = combine([session_points(one, largest_relative_sd=largest_relative_sd) for one in data])
    return Points(combined.points, combined.notes)


def as_points(source: Any) -> Points | None:
    """Return the points in something, None where there are none."""
    if isinstance(source, Points):
        return source
    if isinstance(source, list | tuple) and source and isinstance(source[0], FrequencyPoint):
        return Points(source)
    if hasattr(source, "frdata"):  # python-control's mark of a frequency response
        from autotune.api.python_control import from_control

        converted = from_control(source)
        return converted if isinstance(converted, Points) else None
    measured = getattr(source, "design_points", None)
    return Points(measured) if measured else None
