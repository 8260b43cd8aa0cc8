"""Recordings of rigs in which one effect is concealed, the answer sealed apart.

Three families (ball in a tube, position servo, level and thermal process), made by continuous-time equations that are
this package's own. A case is a function of its seed: calibration uses seeds below 100000, the proof seeds from there.
"""
