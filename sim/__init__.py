"""Rigs that do not exist: an independent truth that shares no code with the tool."""
