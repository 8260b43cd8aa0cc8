"""Frequency points of recordings: relay limit cycles, and any other excitation."""
