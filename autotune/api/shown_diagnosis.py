"""A diagnosis as a table: beside the others, for what it imports is needed by nobody who does not ask for one."""

from __future__ import annotations

from autotune.api.shown import Cell, Row, html, rows_of, text
from autotune.diagnosis.result import Diagnosis


@rows_of.register
def _(result: Diagnosis) -> tuple[str, Row, list[Row]]:
    rows: list[Row] = []
    for effect in result.effects:
        sizes = ", ".join(
            f"{name} {q.value:.4g}" + (f" ± {q.sd:.2g}" if q.sd > 0.0 else "") + (f" {q.unit}" if q.unit else "")
            for name, q in effect.parameters.items()
        )
        probability = Cell(f"{effect.probability:.2f}", effect.probability)
        rows.append((effect.name, probability, ", ".join(effect.places), sizes, effect.equation))
    fit, errors = result.fit, ("nominal", "retuned", "extended")
    left = ", ".join(f"{name} {getattr(fit, name):.3g}" for name in errors)
    said = (
        *result.sentences,
        f"Error of free runs on rows that were not fitted, as a share of the spread of y: {left}.",
    )
    header = ("effect", "probability", "where", "size", "equation")
    return f"Verdict: {result.verdict}", header, [*rows, *((sentence,) for sentence in said)]


setattr(Diagnosis, "_repr_html_", html)  # noqa: B010 - the rooms below know nothing of notebooks
# printed as it is, it would be all recordings, fits and thresholds
setattr(Diagnosis, "__str__", text)  # noqa: B010 - see above
setattr(Diagnosis, "__repr__", text)  # noqa: B010 - see above
