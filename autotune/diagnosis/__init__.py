"""Where simulation and recording differ: which physics was left out."""
