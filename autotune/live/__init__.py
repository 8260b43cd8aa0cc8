"""The live page: a process of its own that reads what a run writes, and hands on what its operator asks."""
