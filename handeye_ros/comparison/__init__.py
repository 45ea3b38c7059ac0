"""The same samples through every estimator."""
