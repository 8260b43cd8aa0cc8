"""Ten plants written down from textbooks and manuals, integrated here, each able to conceal one effect at a time."""

from tests.sim.textbook.flows import FLOWS
from tests.sim.textbook.machines import MACHINES
from tests.sim.textbook.plant import Plant

#: The plants by name.
PLANTS: dict[str, Plant] = {one.name: one for one in (*MACHINES, *FLOWS)}

__all__ = ["PLANTS", "Plant"]
