"""The verdict on a loop in operation in words, and what to do next."""

from __future__ import annotations

import math

from autotune.diagnosis.routine.result import RoutineDiagnosis
from autotune.diagnosis.routine.thresholds import RoutineThresholds


def said(found: RoutineDiagnosis, limits: RoutineThresholds) -> tuple[str, ...]:
    """Return the finding in words, the verdict first."""
    seen = found.oscillation
    period = f"{seen.period_s:.4g} s"
    match found.verdict:
        case "stiction" | "backlash":
            first = _valve(found)
        case "tight_tuning":
            assert found.answer is not None
            first = (
                f"Tight tuning: after changes of the set-point y swings with a period of {found.answer.period_s:.4g} s"
                f" and a damping ratio of {found.answer.damping:g}; a well damped answer predicts stretches left out"
                " clearly worse."
            )
        case "outside_oscillation":
            first = (
                f"An oscillation from outside with a period of {period}: over {seen.periods:.0f} periods its phase"
                f" lasts (one sine predicts {100.0 * seen.phase_kept:.0f} % of y on stretches left out), which neither"
                " a badly damped loop nor a valve that sticks explains."
            )
        case "none":
            first = "Nothing found: no regular oscillation, and no fault of the valve that its slips would show."
        case _:
            first = (
                f"The loop oscillates with a period of {period}, and this record does not tell whether by its tuning,"
                " its valve or from outside."
            )
    return (first, _compared(found), *_reservations(found, limits))


def _valve(found: RoutineDiagnosis) -> str:
    assert found.band is not None
    assert found.jump is not None
    band, jump, span = found.band, found.jump, found.valves.span
    unit = found.operation.u_unit or "unit of u"
    name = "Stiction" if found.verdict == "stiction" else "Play (backlash)"
    said = (
        f"{name} in the valve: the command must turn by {band.value:.3g} ({band.low:.3g} to {band.high:.3g}, {unit};"
        f" {100.0 * band.value / span:.0f} % of u's range) before the valve follows"
    )
    if found.verdict == "stiction":
        said += f", and it then slips by {jump.value:.3g} ({jump.low:.3g} to {jump.high:.3g})"
    return said + ("." if found.kinds_apart else "; sticking and play are not told apart here.")


def _compared(found: RoutineDiagnosis) -> str:
    valves = found.valves
    change = abs(1.0 - math.exp(-valves.decrease))
    less = "less" if valves.decrease >= 0.0 else "more"
    return (
        f"Beside predictions by the command, those by the position of the best faulty valve have {100.0 * change:.0f} %"
        f" {less} squared error than they would in the same loop with a linear valve or a period late, over"
        f" {valves.reversals} reversals; by chance they are as good with a probability of {valves.chance:.2g}."
    )


def _reservations(found: RoutineDiagnosis, limits: RoutineThresholds) -> tuple[str, ...]:
    part = found.operation.seen
    looked_at = f"Looked at: the {100.0 * part:.0f} % of the recorded time in which u travels furthest."
    said = (looked_at,) if part < 1.0 else ()
    return (*_reasons(found, limits), *said)


def _reasons(found: RoutineDiagnosis, limits: RoutineThresholds) -> tuple[str, ...]:
    seen, valves = found.oscillation, found.valves
    if found.verdict == "abstain":
        reasons = []
        if found.answer is None:
            reasons.append("the set-point does not move or was not recorded, so the loop's own damping is not seen")
        if seen.periods < limits.least_periods:
            reasons.append(f"{seen.periods:.0f} periods are too few to see whether its phase lasts")
        elif seen.phase_kept > limits.least_phase:
            reasons.append("its phase lasts, and a valve that sticks is not ruled out")
        else:
            reasons.append("its phase does not last")
        if valves.reversals < limits.least_reversals:
            reasons.append(f"{valves.reversals} reversals of the best faulty valve are too few to see it by")
        elif valves.decrease > 0.0:
            reasons.append("a faulty valve is better than a linear one, but not clearly, or its band may be narrow")
        return (f"Why not: {'; '.join(reasons)}.",)
    return ()


def following(found: RoutineDiagnosis) -> str:
    """Return what to do next."""
    match found.verdict:
        case "stiction" | "backlash":
            return (
                "Put the loop in manual, move the command by half the band in one direction, then back, and watch"
                " whether y follows; then see to the packing, the linkage or the positioner of the valve."
            )
        case "tight_tuning":
            return "Reduce the controller's gain, or tune the loop anew."
        case "outside_oscillation":
            return "Look for the same period in the loops upstream and in the supply."
        case "none":
            return "Nothing to do; record again when the loop oscillates."
        case _:
            return (
                "Put the loop in manual for ten periods: what goes on oscillating comes from outside. Or change the"
                " set-point by steps, ten periods apart, and record r."
            )
