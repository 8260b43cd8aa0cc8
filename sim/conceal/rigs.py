"""The three rigs as their models say and as they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sim.conceal.effects import BALL, PROCESS, SERVO
from sim.conceal.physics import Physics
from sim.conceal.retune import Chain

#: How a model may be written, and what a sensor shows of one unit where it has a gain.
FORMS = ("blocks", "one block", "gain in the sensor")
SENSED = 2.5


@dataclass(frozen=True, kw_only=True)
class NominalRig:
    """Nominal rig: its chain, its words, and how it is recorded."""

    rig: str
    variant: str
    name: str
    blocks: tuple[str, str, str, str]
    output: str
    unit_u: str
    unit_y: str
    chain: Chain
    Ts: float
    rows: int
    burn_in: int
    substeps: int
    horizon: float
    noise_sd: float


def nominal_rig(rng: np.random.Generator, rig: str, variant: str) -> NominalRig:
    """Draw a nominal rig of one family.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of its numbers.
    rig : str
        The family.
    variant : str
        Of a servo "mm" or "rad", of a process "thermal" or "level".
    """
    if rig == BALL:
        return _ball(rng)
    return _servo(rng, variant) if rig == SERVO else _process(rng, variant)


def _ball(rng: np.random.Generator) -> NominalRig:
    Ts = float(rng.choice([0.01, 0.02]))
    chain = Chain(
        integrating=True,
        K=-65.5,
        tau_actuator=0.016668,
        tau_plant=0.36359,
        tau_sensor=0.003333,
        delay=0.0,
        u_offset=5.0,
        y_offset=5.0,
    )
    rows = int(rng.integers(4200, 5600)) if Ts == 0.01 else 3000
    return NominalRig(
        rig=BALL,
        variant="",
        name="ball in tube",
        blocks=("turbine", "ball speed", "ball height", "height sensor"),
        output="height",
        unit_u="V",
        unit_y="V",
        chain=chain,
        Ts=Ts,
        rows=rows,
        burn_in=round(8.0 / Ts),
        substeps=round(Ts / 0.001),
        horizon=2.0,
        noise_sd=float(rng.uniform(0.02, 0.06)),
    )


def _servo(rng: np.random.Generator, variant: str) -> NominalRig:
    in_mm = variant == "mm"
    K = round(float(rng.uniform(45.0, 56.0)), 1) if in_mm else round(float(rng.uniform(4.2, 5.2)), 2)
    chain = Chain(
        integrating=True,
        K=K,
        tau_actuator=0.01,
        tau_plant=round(float(rng.uniform(0.18, 0.25)), 3),
        tau_sensor=0.0,
        delay=0.0,
        u_offset=0.0,
        y_offset=0.0,
    )
    return NominalRig(
        rig=SERVO,
        variant=variant,
        name="position servo",
        blocks=("motor drive", "mass with friction", "position", "encoder"),
        output="position",
        unit_u="V",
        unit_y="mm" if in_mm else "rad",
        chain=chain,
        Ts=0.005,
        rows=int(rng.integers(7300, 7900)),
        burn_in=800,
        substeps=5,
        horizon=1.0,
        noise_sd=float(rng.uniform(0.0024, 0.005)) * K,
    )


def _process(rng: np.random.Generator, variant: str) -> NominalRig:
    thermal = variant == "thermal"
    chain = Chain(
        integrating=False,
        K=round(float(rng.uniform(2.5, 3.2)), 2) if thermal else round(float(rng.uniform(0.65, 0.8)), 3),
        tau_actuator=round(float(rng.uniform(8.0, 11.0) if thermal else rng.uniform(6.0, 9.0)), 1),
        tau_plant=round(float(rng.uniform(31.0, 42.0)), 1),
        tau_sensor=0.0,
        delay=round(float(rng.uniform(1.5, 3.0) if thermal else rng.uniform(2.0, 4.5)), 1),
        u_offset=50.0 if thermal else 40.0,
        y_offset=160.0 if thermal else 50.0,
    )
    Ts = float(rng.choice([0.5, 1.0]))
    return NominalRig(
        rig=PROCESS,
        variant=variant,
        name="thermal process" if thermal else "level process",
        blocks=("heater", "oven", "", "thermometer") if thermal else ("pump", "tank", "", "level transmitter"),
        output="temperature" if thermal else "level",
        unit_u="%",
        unit_y="degC" if thermal else "%",
        chain=chain,
        Ts=Ts,
        rows=int(rng.integers(2400, 3200)) if Ts == 1.0 else int(rng.integers(3600, 4800)),
        burn_in=round(400.0 / Ts),
        substeps=max(2, round(Ts / 0.25)),
        horizon=300.0,
        noise_sd=float(rng.uniform(0.07, 0.16)) * chain.K,
    )


def truth(rng: np.random.Generator, rig: NominalRig, exact: bool, offset: bool) -> Physics:
    """Draw the rig as it is: every number within 20 % of its nominal value, the operating point shifted where asked.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the numbers.
    rig : NominalRig
        As it is believed to be.
    exact : bool
        Whether every number is the nominal one.
    offset : bool
        Whether the operating point is shifted.
    """
    chain = rig.chain
    factors = np.ones(5) if exact else rng.uniform(0.8, 1.2, 5)
    shift = {BALL: 0.03, SERVO: 0.07, PROCESS: 0.0}[rig.rig] * float(rng.uniform(-1.0, 1.0)) if offset else 0.0
    return Physics(
        integrating=float(chain.integrating),
        K=chain.K * factors[0],
        tau_actuator=chain.tau_actuator * factors[1],
        tau_plant=chain.tau_plant * factors[2],
        tau_sensor=chain.tau_sensor * factors[3],
        delay=chain.delay * factors[4],
        u_offset=chain.u_offset + shift,
        y_offset=chain.y_offset,
    )


def linear_truth(p: Physics) -> Chain:
    """Give the true rig's numbers as a chain without its effects."""
    return Chain(
        integrating=p.integrating > 0.0,
        K=p.K,
        tau_actuator=p.tau_actuator,
        tau_plant=p.tau_plant,
        tau_sensor=p.tau_sensor,
        delay=p.delay,
        u_offset=p.u_offset,
        y_offset=p.y_offset,
    )


def model_file(rig: NominalRig, form: str = "blocks") -> str:
    """Nominal model in the project's model format.

    Parameters
    ----------
    rig : NominalRig
        What is written.
    form : str
        One of ``FORMS``: an engineer may write speed and position as one block of second order, or leave the gain to
        the sensor. The chain from command to reading is the same.
    """
    chain = rig.chain
    actuator, body, position, sensor = rig.blocks
    speed = {BALL: "speed", SERVO: "speed", PROCESS: rig.output}[rig.rig]
    speed_unit = rig.unit_y if rig.rig == PROCESS else f"{rig.unit_y}/s"
    blocks: list[list[tuple[str, Any]]] = [
        [("name", actuator), ("place", "actuator"), ("num", [1]), ("den", [chain.tau_actuator, 1])],
        [("name", body), ("place", "plant"), ("num", [chain.K]), ("den", [chain.tau_plant, 1])],
    ]
    if chain.delay > 0.0:
        blocks[0].append(("delay", chain.delay))
    blocks[1] += [("output", speed), ("unit", speed_unit)]
    if chain.integrating and form == "one block":
        blocks[1] = [("name", position), ("place", "plant"), ("num", [chain.K]), ("den", [chain.tau_plant, 1, 0])]
        blocks[1] += [("output", rig.output), ("unit", rig.unit_y)]
    elif chain.integrating:
        integrator: list[tuple[str, Any]] = [("name", position), ("place", "plant"), ("num", [1]), ("den", [1, 0])]
        blocks.append([*integrator, ("output", rig.output), ("unit", rig.unit_y)])
    last = [chain.tau_sensor, 1] if chain.tau_sensor > 0.0 else [1]
    blocks.append([("name", sensor), ("place", "sensor"), ("num", [1]), ("den", last)])
    if form == "gain in the sensor":
        blocks[1][2], blocks[-1][2] = ("num", [chain.K / SENSED]), ("num", [SENSED])
        blocks[1:-1] = [[(key, value) for key, value in block if key != "unit"] for block in blocks[1:-1]]
    lines = [f'name = "{rig.name}"']
    lines += ["[input]", f'unit = "{rig.unit_u}"', f"offset = {chain.u_offset:g}"]
    lines += ["[output]", f'unit = "{rig.unit_y}"', f"offset = {chain.y_offset:g}"]
    for block in blocks:
        lines.append("[[block]]")
        lines += [f"{key} = {_toml(value)}" for key, value in block]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list):
        return "[" + ", ".join(f"{v:g}" for v in value) + "]"
    return f"{value:g}"
