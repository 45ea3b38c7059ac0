"""Points in the base with a calibration: clouds of scans, seams in them."""
