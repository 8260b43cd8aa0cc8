"""Settings that every link to a rig has, each with its own default."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import Field

Timeout: TypeAlias = Annotated[float, Field(gt=0, le=60, description="longest wait for one answer [s], up to 60")]
Retries: TypeAlias = Annotated[
    int, Field(ge=0, le=10, description="further attempts of one request, 0..10; such a sample is marked suspect")
]
Feed: TypeAlias = Annotated[
    float, Field(gt=0, le=60, description="longest time between two heartbeats while the host commands [s]")
]
