"""The version of the tool, for what keeps it with its results."""

__version__ = "0.2.0"
