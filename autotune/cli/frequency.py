"""Commands: frequency points from a recording."""
