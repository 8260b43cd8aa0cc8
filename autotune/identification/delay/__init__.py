"""Delay and parameters of a plant from one recording, at once and on line."""
