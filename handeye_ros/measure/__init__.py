"""The calibration at work: verification routines, scans, seams."""
