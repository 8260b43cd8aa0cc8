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
    lags_per_window: float = known(10.0, "slowest lags", "length of a window: long enough for structure to show", "cost")
    least_window_rows: int = known(60, "rows", "shortest window", "convention")
    least_windows: int = known(6, "windows", "of a recording, where it has the rows; as many stay when data are thinned", "counted")
    unknown_lags: float = known(1.0, "slowest lags", "after the dead time, commands before the recording act no more", "convention")
    most_left_out: float = known(0.03, "of a recording", "that is left out at its beginning at most", "convention")
    # noise
    slow_noise: float = known(0.8, "1", "correlation of the noise from which on it is no matter of single samples", "counted")
    coarse: float = known(25.0, "reduced chi2", "from which on the residual itself is taken for noise", "real rigs")
    # what samples show
    least_run: int = known(3, "rows", "that are no chance where readings are continuous: equal ones in a run, spikes in all", "chance")
    spike: float = known(7.0, "robust sd", "out of its neighbours' mean that make a spike", "chance")
    least_outlier: float = known(3.0, "times the residual", "of spikes out of their neighbours' mean in the residual: less is no matter beside it", "chance")
    samples_clear: float = known(4.0, "2 ln odds", "that runs of spoiled rows give, from which on no fit sees these rows", "convention")
    uneven_stamps: float = known(0.5, "sample times", "spread of the stamps about even ones from which on even times are tried", "convention")
    # the control law
    law_least_change: float = known(0.04, "of the value", "that it is off at least", "convention")
    law_clearly_more: float = known(2.0, "times", "variance that a law must leave whose derivative's filter is not stated", "counted")
    law_most_at_limits: float = known(0.2, "of the rows", "at the command's ends from which on limits made it", "convention")
    # fits
    prior_spread: float = known(0.2, "of the value", "sd of a nominal number: people's gains and lags are right to tens of percent", "convention")
    far_from_prior: float = known(1.5, "prior sd", "of a retuned number that may stand for something else: starts are found anew, and effects looked for beside the nominal numbers too", "convention")
    restart_decrease: float = known(10.0, "chi2", "from which on a restart is taken", "cost")
    # predictions and screening
    linear_share: float = known(0.3, "of chi2", "that an effect's direction may have before it is too large to be linear", "convention")
    searched_rows: int = known(30_000, "rows", "that a search works on at most; the best hypotheses are fitted to all", "cost")
    confirmed: int = known(3, "hypotheses", "leading, that are fitted to all rows where a search worked on some", "cost")
    # adequacy
    adequate: float = known(1.04, "reduced chi2", "up to which a model is adequate, beside one sd of chance, and beyond which something is missing; clean ones leave 1.02", "counted")
    adequate_quick: float = known(1.12, "reduced chi2", "the same of a residual without slow part: physics left out would be slow", "counted")
    white: float = known(1.10, "slow power", "up to which a residual is white, beside two sd of chance", "counted")
    line: float = known(6.0, "log odds", "against chance of the strongest line in the spectrum of noise: one in four hundred", "chance")
    beyond_chance: float = known(25.0, "chi2", "that is no chance: of the largest of some hundred score tests right models leave up to 15, as the best of two hundred starts does", "chance")
    uneven_noise: float = known(4.0, "ratio", "of the variances of innovations along a record up to which a disturbance is steady", "convention")
    majority: float = known(0.5, "of a whole", "from which on a part is most of it: of what jitter explains what varies beside it, of a residual what a description takes away, of the values those that stay (a slow converter, no dropout), of the residual's scatter that of readings which a limit should hold still", "convention")
    # verdict and probabilities
    off_sigmas: float = known(6.0, "sd", "that a law's gain or time, or the operating point, is off what is stated before that is said", "chance")
    temperature: float = known(2.0, "chi2", "that counts as one: neither noise nor a model's error is ever ideal", "counted")
    unknown_odds: float = known(0.03, "odds", "prior, of a cause outside the catalogue where the best explains the recordings", "counted")
    most_probable: float = known(0.99, "probability", "stated at most", "convention")
    # rigs: where the model's error decides, stretches that were left out are what counts
    short_window: float = known(4.0, "slowest times", "length of short windows", "convention")
    least_short_rows: int = known(40, "rows", "of a short window", "convention")
    long_window: float = known(8.0, "slowest times, or periods", "length of long windows of a plant that integrates or rings", "convention")
    ringing: float = known(0.05, "damping", "below which long windows are some periods", "convention")
    swinging: float = known(0.5, "damping", "below which a fit goes from short to long windows", "convention")
    rig_rows: int = known(9000, "rows", "fitted at most", "cost")
    foretold: float = known(2.0, "times the fitted rows'", "error of rows that were left out, up to which what leaves noise is taken for true: start states cost up to half as much again", "counted")
    material: float = known(0.1, "of a whole", "that matters beside it: of the held-out error, what one more effect or term takes away where the search goes on; of the noise's variance and of the squared error, a converter's rounding; of what effects gained, what varies beside them where they are not true (right ones leave two hundredths, wrong ones a third)", "cost")
    material_numbers: float = known(0.25, "of the error", "that retuned numbers must take away to replace nominal ones where no effect is found, and even times to replace stamps", "convention")
    rig_effects: int = known(4, "effects", "in one hypothesis at most", "cost")
    rig_beam: int = known(2, "hypotheses", "that are built on", "cost")
    rig_starts: int = known(2, "starting points", "of an effect that are fitted", "cost")
    rig_pruned: int = known(4, "hypotheses", "leading, of which each effect is left out once more", "cost")
    rig_tried: int = known(8, "effects", "beside one hypothesis that are fitted, and of the fits those that are judged on left-out stretches", "cost")
    out_of_phase: float = known(0.3, "of the spread", "held-out error from which on a free run may be out of phase", "convention")
    # equations: any model, judged as it runs freely through windows of a third of a recording
    equation_astray: float = known(2.0, "times the noise", "variance from which on fits begin anew from short windows", "cost")
    equation_behind: float = known(300.0, "chi2", "behind one that leaves noise with which a fit is not finished", "cost")
    equation_rows: int = known(2000, "rows", "that a search works on; the leading effects are fitted to all", "cost")
    equation_near: float = known(0.5, "of the best decrease", "of the logarithm of the squared error, from which on others are fitted to all rows too", "cost")
    equation_fitted: int = known(6, "effects", "fitted of those that predict most", "cost")
    equation_further: int = known(4, "effects", "the same beside other effects", "cost")
    equation_faint: float = known(0.02, "of the best", "predicted decrease, below which an effect is not fitted", "cost")
    # what to record next
    still_open: float = known(0.02, "probability", "of a hypothesis that is still open", "convention")
    most_open: int = known(4, "hypotheses", "that an experiment is planned between", "cost")
    decided: float = known(0.9, "probability", "from which on one is left", "convention")
    certain_discrimination: float = known(400.0, "chi2", "expected, above which more is worth nothing", "convention")
    # fmt: on


#: The table in use.
IN_USE = Thresholds()


def table(thresholds: Any) -> list[tuple[str, float, str, str, Origin]]:
    """Return the rows of a table of such fields: name, value, unit, meaning, origin."""
    return [
        (f.name, float(getattr(thresholds, f.name)), f.metadata["unit"], f.metadata["meaning"], f.metadata["origin"])
        for f in fields(thresholds)
    ]
