"""One sample as a control law sees it, and how late samples were."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Tick:
    """One sample as a control law sees it.

    Attributes
    ----------
    k : int
        Row number.
    t_s : float
        Time since the loop began [s].
    y : float
        Measurement; where this sample was unusable, the last usable one [y unit].
    usable : bool
        Whether ``y`` is this sample's own; an unusable one is NaN in the recording.
    u : float
        Command held until now [u unit].
    slot : int
        Number of the sample time that it belongs to: ahead of ``k`` by the samples that were missed or not taken.
    """

    k: int
    t_s: float
    y: float
    usable: bool
    u: float
    slot: int = 0


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Latency and lateness of the loop [s]: median, 99th percentile, worst; and the samples that were left out.

    Attributes
    ----------
    latency_s, lateness_s : (float, float, float)
        Time of a reading on the link, and from a sample's deadline to when the loop woke for it [s].
    decision_s : (float, float, float)
        Time from a sample's stamp to its command in the device, acknowledged [s]; NaN where nobody has measured it.
    missed, unusable, rows : int
        Sample times without a row, rows whose reading was not used, rows.
    """

    latency_s: tuple[float, float, float]
    lateness_s: tuple[float, float, float]
    missed: int
    unusable: int
    rows: int = 0
    decision_s: tuple[float, float, float] = (math.nan, math.nan, math.nan)

    @property
    def missed_share(self) -> float:
        """Share of the sample times that have no row."""
        return self.missed / max(self.missed + self.rows, 1)

    def to_table(self) -> dict[str, Any]:
        """Return the timing as a table of the recording's sidecar."""
        return {
            "latency_s": [value for value in self.latency_s if math.isfinite(value)],
            "lateness_s": [value for value in self.lateness_s if math.isfinite(value)],
            "decision_s": [value for value in self.decision_s if math.isfinite(value)],
            "missed_samples": self.missed,
            "unusable_samples": self.unusable,
            "rows": self.rows,
        }

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Timing:
        """Return the timing that :meth:`to_table` wrote; NaN where a killed process left none."""
        unknown = (math.nan, math.nan, math.nan)
        return cls(
            latency_s=tuple(table.get("latency_s") or unknown),
            lateness_s=tuple(table.get("lateness_s") or unknown),
            missed=table.get("missed_samples", 0),
            unusable=table.get("unusable_samples", 0),
            rows=table.get("rows", 0),
            decision_s=tuple(table.get("decision_s") or unknown),
        )
