"""Points in the base from a calibration: scans, and seams in them."""
