"""What a recording's sidecar keeps of a sweep that was estimated together, and the same estimate from it again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from autotune.errors import InputError
from autotune.identification.frequency.limit_cycle import WholePeriods
from autotune.identification.sweep_estimate import SweepEstimate, estimate_sweep
from autotune.points import FrequencyPoint
from autotune.recording import Recording

#: key of the sidecar
NOTED = "together"


def note_of(found: SweepEstimate | None, why: str, cycles: int, phases_rad: Sequence[float]) -> dict[str, Any]:
    """Return what the sidecar keeps.

    Parameters
    ----------
    found : SweepEstimate or None
        The estimate, where there is one.
    why : str
        Why it is not used; empty where it is.
    cycles : int
        Limit cycles whose rows gave it.
    phases_rad : sequence of float
        Phases at which no limit cycle was run and a point is wanted [rad].
    """
    noted: dict[str, Any] = {"used": found is not None and not why, "why": why}
    if found is not None and not why:
        noted |= {"cycles": cycles, "start_s": found.start_s, "end_s": found.end_s, "phases_rad": list(phases_rad)}
    return noted


def is_noted(metadata: Mapping[str, Any], cycles: int) -> bool:
    """Return whether a recording's sidecar says that its rows gave the points, and no cycle of theirs was lost.

    Parameters
    ----------
    metadata : mapping
        Of the recording's sidecar.
    cycles : int
        How many limit cycles are noted with it.
    """
    noted = metadata.get(NOTED)
    return isinstance(noted, dict) and noted.get("used") is True and noted.get("cycles") == cycles


def reason_noted(metadata: Mapping[str, Any]) -> str:
    """Return why the points are not of all rows together, as a recording's sidecar says; empty where it does not."""
    noted = metadata.get(NOTED)
    return str(noted.get("why", "")) if isinstance(noted, dict) else ""


def estimate_again(recording: Recording, points: Sequence[FrequencyPoint]) -> SweepEstimate | None:
    """Return the estimate that a recording's sidecar notes; None where it notes none.

    Parameters
    ----------
    recording : Recording
        With its sidecar.
    points : sequence of FrequencyPoint
        Of its limit cycles, in the order in which the sidecar has them.

    Raises
    ------
    InputError
        The sidecar lacks what it should have.
    IdentificationError
        The rows determine no plant.
    """
    if not is_noted(recording.metadata, len(points)):
        return None
    try:
        tables, noted = recording.metadata["relay"], recording.metadata[NOTED]
        windows = [
            WholePeriods(start_s=float(one["start_s"]), end_s=float(one["end_s"]), periods=int(one["periods"]))
            for one in tables
        ]
        phases = [float(one["phase_rad"]) for one in tables]
        start_s, end_s = float(noted["start_s"]), float(noted["end_s"])
        further = [float(phase) for phase in noted["phases_rad"]]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the sidecar's table of the sweep lacks {error}", where=recording.name) from None
    at = {phase: point.omega_rad_s for phase, point in reversed(list(zip(phases, points, strict=True)))}
    return estimate_sweep(
        recording, list(zip(points, windows, strict=True)), start_s, end_s, tuple(at.values()), further
    )
