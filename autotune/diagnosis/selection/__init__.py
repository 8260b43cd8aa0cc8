"""Hypotheses: predicted, screened, fitted, compared."""
