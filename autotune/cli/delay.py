"""Commands: delay identification, and the on-line estimator that watches a loop."""
