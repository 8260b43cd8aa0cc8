"""Simulated plants, and the twin of a real rig that is one."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from autotune.schema import Section


class PlantSettings(Section):
    """A simulated plant: one of four or that of a model file, and what is drawn for it."""

    plant: Annotated[
        Literal["ball", "servo", "two_tank", "thermal"] | None, Field(description="which simulated plant")
    ] = None
    model: Annotated[
        str | None, Field(description="model file (TOML) of the plant in place of plant: a chain of blocks, equations")
    ] = None
    seed: Annotated[int, Field(ge=0, description="draws the hover voltage and the noise")] = 0
    noise: Annotated[float | None, Field(ge=0, description="half-width of the uniform noise on y [y unit]")] = None
    resolution: Annotated[
        float | None, Field(gt=0, description="step of the converter of y, of a model's plant [y unit]")
    ] = None
    start: Annotated[str | None, Field(description='where it starts, "floor" or "afloat" for the ball')] = None

    @model_validator(mode="after")
    def _one_plant(self) -> PlantSettings:
        if (self.plant is None) == (self.model is None):
            raise ValueError("give plant or model, and not both")
        if self.plant is not None and self.resolution is not None:
            raise ValueError("resolution is of a model's plant; the four plants bring their own converters")
        if self.model is not None and self.start is not None:
            raise ValueError("start is of the four plants; a model starts at rest, or where its states say")
        return self


class TwinSettings(PlantSettings):
    """The simulated twin of a real rig: ``--dry-run`` runs it in process, ``autotune rig`` serves it."""

    listen: Annotated[str, Field(description="address that autotune rig listens on; loopback by default")] = "127.0.0.1"
    deadman_s: Annotated[
        float, Field(gt=0, le=60, description="time without heartbeat after which the twin is safe [s], up to 60")
    ] = 0.5
    device: Annotated[
        str | None,
        Field(description="serial device that autotune rig sits on; absent: a pseudo-terminal, linked at rig.device"),
    ] = None
    cert_file: Annotated[str | None, Field(description="certificate of the served twin, PEM (TLS)")] = None
    key_file: Annotated[str | None, Field(description="private key of the served twin, PEM (TLS)")] = None
