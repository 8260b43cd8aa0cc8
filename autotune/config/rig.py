"""How the rig is reached: one table ``[rig]``, its ``kind`` says which."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias, get_args

from pydantic import Field

from autotune.config.procedure import Section


class SimulatedRigSettings(Section):
    """A plant in process, on a virtual clock."""

    kind: Literal["simulated"]
    plant: Annotated[Literal["ball", "servo", "two_tank", "thermal"], Field(description="which simulated plant")]
    seed: Annotated[int, Field(ge=0, description="draws the hover voltage and the noise")] = 0
    noise: Annotated[float | None, Field(ge=0, description="half-width of the uniform noise on y [y unit]")] = None


RigSettings: TypeAlias = Annotated[SimulatedRigSettings, Field(description="how the rig is reached")]

RIG_KINDS = frozenset(get_args(model.model_fields["kind"].annotation)[0] for model in (SimulatedRigSettings,))
