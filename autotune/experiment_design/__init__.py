"""Which experiment tells apart what a diagnosis leaves open; pure, nothing here touches a rig."""

from autotune.experiment_design.next_experiment import next_experiment, with_next_experiment
from autotune.experiment_design.plan import Plan, plan_in

__all__ = ["Plan", "next_experiment", "plan_in", "with_next_experiment"]
