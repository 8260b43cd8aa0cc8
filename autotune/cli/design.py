"""Commands: design on a model or on points, and margins of a given controller."""
