"""What is to be done on the rig: signals, limits, operating point, experiment, design, verification."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from autotune.schema import LARGEST, SHORTEST_S, Number, Section, Text, Time


class SignalSettings(Section):
    """Units and sample time."""

    sample_time_s: Annotated[float, Field(ge=SHORTEST_S, le=3600, description="control period [s], 1e-6 up to 3600")]
    u_unit: Annotated[Text, Field(description="unit of the command, as people say it")] = ""
    y_unit: Annotated[Text, Field(description="unit of the measurement, as people say it")] = ""
    u_step: Annotated[
        Number, Field(ge=0, description="resolution of the command, whose multiples are sent [u unit]; 0 for any value")
    ] = 0.0


class LimitSettings(Section):
    """Safety envelope: applied to every command, in every state."""

    u_min: Annotated[Number, Field(description="lowest command [u unit]")]
    u_max: Annotated[Number, Field(description="highest command [u unit]")]
    u_safe: Annotated[Number, Field(description="command the rig is left with [u unit], within u_min..u_max")]
    u_rate: Annotated[Number, Field(gt=0, description="largest change of the command per second [u unit/s]")] = 1e9
    y_min: Annotated[
        Number,
        Field(
            description="lowest measurement the experiment may see [y unit]; a rig that begins below it may go half a"
            " swing lower until it is brought to its operating point"
        ),
    ]
    y_max: Annotated[
        Number, Field(description="highest measurement the experiment may see [y unit]; of a start beyond it as y_min")
    ]
    swing: Annotated[
        Number,
        Field(
            gt=0,
            description="largest departure of y from the operating point [y unit], in every state; a rig that begins"
            " further away may go half a swing beyond where it began until it is brought there. Judged by the median of"
            " five readings, beside the noise; what the rig does after the safe command is beyond it",
        ),
    ]
    time_s: Annotated[Time, Field(description="longest time on the rig [s]")] = 600.0
    late_s: Annotated[
        float,
        Field(gt=0, le=60, description="longest time the loop may be behind its schedule [s]; five samples always are"),
    ] = 0.15
    blind_s: Annotated[
        float | None,
        Field(
            gt=0, le=60, description="longest time without a usable reading [s]; absent: five samples, or late_s in all"
        ),
    ] = None

    @model_validator(mode="after")
    def _ordered(self) -> LimitSettings:
        if not self.u_min < self.u_max:
            raise ValueError(f"u_min = {self.u_min:g} must be below u_max = {self.u_max:g}")
        if not self.u_min <= self.u_safe <= self.u_max:
            raise ValueError(f"u_safe = {self.u_safe:g} must lie within u_min..u_max")
        if not self.y_min < self.y_max:
            raise ValueError(f"y_min = {self.y_min:g} must be below y_max = {self.y_max:g}")
        if self.swing > self.y_max - self.y_min:
            raise ValueError(
                f"swing = {self.swing:g} is more than y_min..y_max allow, {self.y_max - self.y_min:g}, and limits"
                " nothing: give the largest departure from the operating point that the rig may see"
            )
        return self


class OperatingPointSettings(Section):
    """Where the loop is commissioned, and how to get there."""

    y: Annotated[Number, Field(description="measurement to oscillate around [y unit]")]
    u_guess: Annotated[Number, Field(description="nominal command that holds it [u unit]")]
    u_uncertainty: Annotated[Number, Field(gt=0, description="how far the true one may be from u_guess [u unit]")]
    approach: Annotated[
        Literal["ramp", "hold"],
        Field(
            description="ramp the command until y moves; or start where the rig is, under the command that it says it"
            " applies where y is near the operating point, else under u_guess"
        ),
    ] = "ramp"
    plant_sign: Annotated[
        int, Field(ge=-1, le=1, description="sign of the plant's gain, -1 or 1; 0 to have it measured")
    ] = 0
    ramp_rate: Annotated[
        float | None,
        Field(
            gt=0,
            le=LARGEST,
            description="change of the command on a ramp [u unit/s]; default u_uncertainty in 600 samples of >= 10 ms",
        ),
    ] = None


#: A lag and an integrator, which the sweep is planned with, have their phases between these.
Phase = Annotated[float, Field(ge=-179.0, le=-91.0)]


class ExperimentSettings(Section):
    """Relay sweep."""

    phases_deg: Annotated[
        tuple[Phase, Phase],
        Field(description="phases of the plant (positive gain) between which points are wanted [deg], -91 to -179"),
    ] = (-105.0, -160.0)
    points: Annotated[int, Field(ge=3, le=20, description="number of points, 3 to 20")] = 5
    relay_amplitude: Annotated[
        float | None,
        Field(gt=0, le=LARGEST, description="half-amplitude of the relay [u unit]; chosen by the tool when absent"),
    ] = None
    gain_sd: Annotated[
        float, Field(gt=0, lt=0.5, description="relative standard deviation at which a point is good enough")
    ] = 0.004
    goal: Annotated[
        Literal["points", "controller"],
        Field(
            description="when points that are estimated together are good enough: at gain_sd, or where the rest of the"
            " budget would make the controller better by less than 1 %"
        ),
    ] = "points"
    budget_s: Annotated[Time, Field(description="rig time for the sweep [s]")] = 60.0
    together: Annotated[
        bool,
        Field(
            description="estimate all points together from three limit cycles where a test allows it, which takes half"
            " the time; false: a limit cycle for each"
        ),
    ] = True

    @model_validator(mode="after")
    def _apart(self) -> ExperimentSettings:
        if abs(self.phases_deg[0] - self.phases_deg[1]) < 5.0:
            raise ValueError("phases_deg must be at least 5 degrees apart")
        return self


SPECIFICATIONS = {"Spec1": (0.5, 45.0), "Spec2": (0.8, 60.0)}


class DesignSettings(Section):
    """Specification of the controller: a named one, or margins that replace its values."""

    kind: Annotated[Literal["pi", "pid"], Field(description="structure of the controller")] = "pi"
    specification: Annotated[
        Literal["Spec1", "Spec2"],
        Field(description="Spec1: modulus margin 0.5 and 45 deg; Spec2: 0.8 and 60 deg (plant that varies)"),
    ] = "Spec1"
    modulus_margin: Annotated[float | None, Field(gt=0, lt=1, description="replaces the named one, 0 to 1")] = None
    phase_margin_deg: Annotated[float | None, Field(gt=0, lt=90, description="replaces the named one [deg]")] = None
    noise_gain: Annotated[
        float | None,
        Field(
            gt=0,
            le=LARGEST,
            description="largest amplification of measurement noise to command, N_max [u/y unit];"
            " from the measured noise and the command's range when absent",
        ),
    ] = None
    noise_frequency_rad_s: Annotated[
        float | None, Field(gt=0, description="lowest frequency of the noise [rad/s]; the crossover when absent")
    ] = None
    sample_time_s: Annotated[
        float | None,
        Field(
            ge=SHORTEST_S,
            le=3600,
            description="period of the controller that is to run [s], two of which the delay margin has at least; the"
            " recording's, or the rig's, when absent",
        ),
    ] = None
    criterion: Annotated[
        Literal["auto", "h2", "iae"],
        Field(
            description="minimised after a step of load: the norm (11), or the integral of the absolute error; auto"
            " takes iae for a plant fitted to plain recordings, h2 for points"
        ),
    ] = "auto"
    source: Annotated[
        Literal["auto", "reduced model", "points", "fitted plant"],
        Field(
            description="what to design on: the reduced model (PI), the measured points and their regions, or the"
            " fitted plant and its region; auto takes the first that keeps its margins on everything measured"
        ),
    ] = "auto"

    @property
    def margins(self) -> tuple[float, float]:
        """Modulus margin and phase margin [rad] to be kept."""
        modulus, phase_deg = SPECIFICATIONS[self.specification]
        modulus = self.modulus_margin if self.modulus_margin is not None else modulus
        phase_deg = self.phase_margin_deg if self.phase_margin_deg is not None else phase_deg
        return modulus, math.radians(phase_deg)


class ControllerSettings(Section):
    """The gains the loop has now: restored when the new ones do not verify."""

    K: Annotated[Number, Field(description="proportional gain with its sign [u unit/y unit]")]
    Ti_s: Annotated[Time, Field(description="integral time [s]")]


class ApprovalSettings(Section):
    """Gains are handed over with a second person's name and reason only; absent: whoever runs the tool may."""

    approvers: Annotated[tuple[Text, ...], Field(description="who may approve; empty: anybody but who asks")] = ()


class VerificationSettings(Section):
    """Set-point step and input-disturbance step on the rig with the new gains, compared with the prediction."""

    setpoint_step: Annotated[
        Number | None,
        Field(
            description="step of the set-point [y unit]; default swing / 3, less where the command has no room for it"
        ),
    ] = None
    disturbance_step: Annotated[
        Number | None,
        Field(description="step added to the command [u unit]; chosen from the design when absent"),
    ] = None
    duration_s: Annotated[Time | None, Field(description="time per step [s]; chosen from the design when absent")] = (
        None
    )

    @model_validator(mode="after")
    def _steps(self) -> VerificationSettings:
        for key, value in (("setpoint_step", self.setpoint_step), ("disturbance_step", self.disturbance_step)):
            if value == 0.0:
                raise ValueError(f"{key} = 0 is no step; leave the key out to have it chosen")
        return self
