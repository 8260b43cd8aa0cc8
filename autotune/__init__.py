"""Relay autotuner with hardware in the loop: measures a rig's Bode points, designs its controller, verifies it."""

__version__ = "0.1.0"
