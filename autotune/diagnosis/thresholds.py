"""The thresholds of the diagnosis: one table, passed in with the data, read from nowhere else.

Every number that decides between two findings stands here with its unit, its meaning and where its value comes from.
Numbers that only say how a method computes (nodes of a table, damping of a step, frequencies of a scan) stay with the
method.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Literal, TypeAlias, TypeVar

#: Where a value comes from. ``counted``: on concealed cases, none of them of the proof.
#: ``real rigs``: on recordings of real rigs, where no model is adequate. ``chance``: a quantile of what noise alone brings.
#: ``convention``: usual in the field. ``cost``: a compromise between time and what is found.
Origin: TypeAlias = Literal["counted", "real rigs", "chance", "convention", "cost"]
_T = TypeVar("_T", int, float)


def known(value: _T, unit: str, meaning: str, origin: Origin) -> _T:
    """Return a field of a table of thresholds: its value, its unit, what it means, and where it comes from."""
    entry: Any = field(default=value, metadata={"unit": unit, "meaning": meaning, "origin": origin})
    return entry  # type: ignore[no-any-return]  # a field stands for its value until the class is made


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """Every number that decides between two findings; units are those of :func:`table`."""

    # fmt: off
    # windows
    lags_per_window: float = known(10.0, "slowest lags", "length of a window near the noise: long enough for structure to show", "cost")
    least_window_rows: int = known(40, "rows", "shortest window", "convention")
    least_windows: int = known(6, "windows", "of a recording, where it has the rows; as many stay when data are thinned", "counted")
    most_left_out: float = known(0.03, "of a recording", "that is left out at its beginning at most", "convention")
    # noise
    slow_noise: float = known(0.8, "1", "correlation of the noise from which on it is no matter of single samples", "counted")
    coarse: float = known(25.0, "reduced chi2", "from which on the residual itself is taken for noise", "real rigs")
    # what samples show
    least_run: int = known(3, "rows", "that are no chance where readings are continuous: equal ones in a run, spikes in all", "chance")
    spike: float = known(7.0, "robust sd", "out of its neighbours' mean that make a spike", "chance")
    least_outlier: float = known(3.0, "times the residual", "of spikes out of their neighbours' mean in the residual: less is no matter beside it", "chance")
    uneven_stamps: float = known(0.5, "sample times", "spread of the stamps about even ones from which on even times are tried", "convention")
    # the control law
    law_least_change: float = known(0.04, "of the value", "that it is off at least", "convention")
    law_most_at_limits: float = known(0.2, "of the rows", "at the command's ends from which on limits made it", "convention")
    # fits
    prior_spread: float = known(0.2, "of the value", "sd of a nominal number: people's gains and lags are right to tens of percent", "convention")
    far_from_prior: float = known(1.5, "prior sd", "of a retuned number that may stand for something else: starts are found anew, and effects looked for beside the nominal numbers too", "convention")
    # predictions and screening
    linear: float = known(0.3, "of a whole", "beyond which no derivative tells where to go: of chi2, by which an effect may move what is read; of its spread, by which a free run may err", "convention")
    searched_rows: int = known(30_000, "rows", "that a search works on at most; the best hypotheses are fitted to all", "cost")
    # adequacy
    adequate: float = known(1.04, "reduced chi2", "up to which a model is adequate, beside one sd of chance, and beyond which something is missing; clean ones leave 1.02", "counted")
    white: float = known(1.10, "of what is ideal", "up to which a residual is noise beside two sd of chance: its slow power; and its reduced chi2 where it has no slow part, for physics left out would be slow", "counted")
    line: float = known(6.0, "log odds", "against chance of the strongest line in the spectrum of noise: one in four hundred", "chance")
    beyond_chance: float = known(25.0, "chi2", "that is no chance, of one number 5 sd: of the largest of some hundred score tests right models leave up to 15, as the best of two hundred starts does", "chance")
    uneven_noise: float = known(4.0, "ratio", "of the variances of innovations along a record up to which a disturbance is steady", "convention")
    majority: float = known(0.5, "of a whole", "from which on a part is most of it: of what jitter explains what varies beside it, of a residual what a description takes away, of the values those that stay (a slow converter, no dropout), of the residual's scatter that of readings which a limit should hold still", "convention")
    # verdict and probabilities
    temperature: float = known(2.0, "chi2", "that counts as one: neither noise nor a model's error is ever ideal", "counted")
    unknown_odds: float = known(0.03, "odds", "prior, of a cause outside the catalogue where the best explains the recordings; a hypothesis less probable is no longer open", "counted")
    # rigs: where the model's error decides, stretches that were left out are what counts
    long_window: float = known(8.0, "slowest times, or periods", "length of windows of a plant that integrates or rings; short ones are half as long", "convention")
    ringing: float = known(0.05, "damping", "below which long windows are some periods", "convention")
    swinging: float = known(0.5, "damping", "below which a fit goes from short to long windows", "convention")
    rig_rows: int = known(9000, "rows", "fitted at most", "cost")
    foretold: float = known(2.0, "times the fitted rows'", "error of rows that were left out, up to which what leaves noise is taken for true: start states cost up to half as much again", "counted")
    material: float = known(0.1, "of a whole", "that matters beside it: of the held-out error, what one more effect or term takes away where the search goes on; of the noise's variance and of the squared error, a converter's rounding; of what effects gained, what varies beside them where they are not true (right ones leave two hundredths, wrong ones a third)", "cost")
    material_numbers: float = known(0.25, "of the error", "that retuned numbers must take away to replace nominal ones where no effect is found, and even times to replace stamps", "convention")
    rig_effects: int = known(4, "effects", "in one hypothesis at most", "cost")
    followed: int = known(2, "of a ranking", "that are followed: hypotheses that are built on, starting points of an effect that are fitted", "cost")
    leading: int = known(4, "hypotheses", "leading: each effect of them is left out once more, they are fitted to all rows where a search worked on some, and an experiment is planned between them", "cost")
    tried: int = known(8, "effects", "beside one hypothesis that are fitted, and of the fits those that are judged on left-out stretches", "cost")
    clearly_more: float = known(2.0, "times", "variance that is clearly more: than the noise, so that fits begin anew from short windows; than another law leaves", "counted")
    certain: float = known(400.0, "chi2", "above which more says nothing more: of a fit behind one that leaves noise, of what an experiment may tell", "cost")
    equation_rows: int = known(2000, "rows", "that a search works on; the leading effects are fitted to all", "cost")
    # what to record next
    decided: float = known(0.9, "probability", "from which on one is left: of hypotheses, and of rows that are spoiled or not, before any fit sees them", "convention")
    # fmt: on


#: The table in use.
IN_USE = Thresholds()


def table(thresholds: Any) -> list[tuple[str, float, str, str, Origin]]:
    """Return the rows of a table of such fields: name, value, unit, meaning, origin."""
    return [
        (f.name, float(getattr(thresholds, f.name)), f.metadata["unit"], f.metadata["meaning"], f.metadata["origin"])
        for f in fields(thresholds)
    ]
