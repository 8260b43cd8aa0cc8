"""Units as engineers write them: their dimension and their size."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

#: Units that engineers write and the library of units does not know; they have no dimension.
PLAIN = {"", "1", "-", "%", "count", "counts", "step", "steps", "lsb", "digit", "pu", "p.u.", "duty", "pwm"}
_SPELT = {"°C": "degC", "°F": "degF", "°": "deg", "Ω": "ohm", "µ": "u", "²": "^2", "³": "^3", "·": " ", "⋅": " ",
          "Nm^3": "m^3", "Nm3": "m^3"}  # fmt: skip
#: What engineers mean by names that the library of units knows as something else, or not at all: there Nm is a
#: fineness of yarn, Nms are several of it, and cfm a hundredth of a femtometre.
_MEANT = (
    "newton_metre = newton * metre = Nm", "newton_metre_second = newton * metre * second = Nms",
    "newton_second = newton * second = Ns", "pascal_second = pascal * second = Pas",
    "volt_second = volt * second = Vs", "ampere_second = ampere * second = As", "watt_second = watt * second = Ws",
    "cubic_foot_per_minute = foot ** 3 / minute = cfm", "acidity = 1 = pH", "hundredth = 0.01 = pct",
)  # fmt: skip
#: Base units as a person writes them.
_SHORT = {"meter": "m", "kilogram": "kg", "second": "s", "ampere": "A", "kelvin": "K", "mole": "mol", "gram": "g"}
#: A power as plain text has it: m/s2, m s-2.
_PLAIN_POWER = re.compile(r"(?<=[A-Za-z])(-?[1-9])\b")


@dataclass(frozen=True, kw_only=True)
class Unit:
    """A unit as powers of base units and a factor to them; factor NaN where a number may have converted it."""

    powers: tuple[tuple[str, float], ...]
    factor: float

    @property
    def is_plain(self) -> bool:
        """Whether it has no dimension."""
        return not self.powers

    @property
    def text(self) -> str:
        """Its base units as a person writes them."""
        parts = [_SHORT.get(n, n) + ("" if p == 1.0 else f"^{p:g}") for n, p in self.powers]
        return " ".join(parts) or "a plain number"

    def is_as_large_as(self, other: Unit) -> bool:
        """Whether a unit of the same dimension has the same size, as far as both sizes are known."""
        return not abs(self.factor / other.factor - 1.0) > 1e-6  # NaN: not comparable

    def times(self, other: Unit, power: float = 1.0) -> Unit:
        """Return the product with another unit.

        Parameters
        ----------
        other : Unit
            The other factor.
        power : float
            To which that is raised first.
        """
        powers = dict(self.powers)
        for name, exponent in other.powers:
            powers[name] = powers.get(name, 0.0) + power * exponent
        kept = tuple(sorted((n, round(p, 9)) for n, p in powers.items() if abs(p) > 1e-9))
        return Unit(powers=kept, factor=self.factor * other.factor**power)


def read_unit(text: str) -> Unit | None:
    """Return what a unit's text means; None where it is not known."""
    return _parse(text.strip())


@lru_cache(maxsize=512)
def _parse(text: str) -> Unit | None:
    if text.lower() in PLAIN:
        return Unit(powers=(), factor=0.01 if text == "%" else 1.0)
    for given, known in _SPELT.items():
        text = text.replace(given, known)
    found = _base_units(text) or _base_units(_PLAIN_POWER.sub(r"^\1", text))
    if found is None:
        return None
    factor, base = found
    powers = tuple(sorted((str(n), float(p)) for n, p in base._units.items() if str(n) != "radian"))
    return Unit(powers=tuple((n.removeprefix("delta_"), p) for n, p in powers), factor=factor)


def _base_units(text: str) -> tuple[float, Any] | None:
    registry = _registry()
    try:
        factor, base = registry.get_base_units(registry.parse_units(text, as_delta=True))
    except Exception:  # the library has many ways to say that it does not know
        return None
    return float(factor), base


@lru_cache(maxsize=1)
def _registry() -> Any:
    import pint

    registry = pint.UnitRegistry(on_redefinition="ignore")
    for line in _MEANT:
        registry.define(line)
    return registry
