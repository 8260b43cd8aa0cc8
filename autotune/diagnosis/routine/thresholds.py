"""The thresholds of the look at routine records: one frozen table; those ``counted`` on simulated loops.

``python -m tests.benchmarks routine`` counts them again.
"""

from __future__ import annotations

from dataclasses import dataclass

from autotune.diagnosis.thresholds import known


@dataclass(frozen=True, kw_only=True)
class RoutineThresholds:
    """Every number that decides between two findings."""

    # fmt: off
    # records and windows
    least_rows: int = known(100, "rows", "of a record", "convention")
    most_rows: int = known(8000, "rows", "that are fitted; of a longer record the part in which u travels furthest", "cost")
    thinned_from: int = known(2500, "rows", "of all recordings, from which on they are thinned", "cost")
    most_rows_per_period: int = known(40, "rows", "of the dominant oscillation; with more the record is thinned", "cost")
    periods_per_window: float = known(3.0, "periods", "that a free run lasts", "convention")
    least_window_rows: int = known(30, "rows", "that a free run lasts", "convention")
    least_stretches: int = known(6, "stretches", "in which a record is cut: five degrees of freedom", "chance")
    most_stretches: int = known(12, "stretches", "in which a record is cut", "cost")
    # a valve's fault
    predicted_per_period: int = known(24, "rows", "of the dominant oscillation that are predicted, each a mean over its time", "convention")
    order: int = known(8, "rows", "of the past that a prediction sees: a third of a period", "convention")
    chance: float = known(0.005, "probability", "that the best faulty valve gains as much in the same loop with a linear one", "chance")
    least_decrease: float = known(0.2, "ln of squared error", "that predictions by the valve's position must bring beyond what they bring in the same loop with a linear valve, or a period late: 18 % less", "counted")
    least_reversals: int = known(6, "reversals", "of the best faulty valve, before its fault is named: what has not turned has shown nothing of its band", "convention")
    least_band: float = known(0.1, "of u's range", "the narrowest band of a valve that is looked for; narrower ones act as dead time", "counted")
    unlikely: float = known(0.05, "probability", "up to which what is not said may be true: that the other kind of fault wins in a resampling where sticking and play are told apart, or that chance made a faulty valve better than a linear one; what as rare a chance brings is what a decrease is measured from", "convention")
    resamplings: int = known(399, "resamplings", "of the linear loop's errors, for the chance, and of the half cycles, for the band's interval", "cost")
    # an oscillation
    regular: float = known(1.0, "1", "regularity from which on a signal oscillates (Thornhill et al. 2003)", "convention")
    least_share: float = known(0.3, "of y's variance", "in one line, or on stretches left out predicted from the set-point, before it is read", "convention")
    least_phase: float = known(0.8, "of y's variance", "on stretches left out that one sine predicts, before it is called persistent", "counted")
    least_periods: float = known(20.0, "periods", "through which a phase must last: a ringing loop of damping 0.01 has forgotten it by then", "convention")
    # answers to the set-point
    badly_damped: float = known(0.1, "1", "damping ratio up to which a loop is tightly tuned: the overshoot of a step is 73 %", "convention")
    # fmt: on
