"""Estimators: from recordings to frequency points and models, each with its covariance."""
