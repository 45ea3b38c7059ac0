"""One least squares for all targets: problem, weights, robust start, noise."""
