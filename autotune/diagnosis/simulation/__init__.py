"""A model with effects in it, compiled and driven by a recording."""
