"""Commands: simulation of a model on a recording, and diagnosis of where the two differ."""
