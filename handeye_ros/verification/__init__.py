"""Verification of a calibration: routines on known artefacts, and checks on its own target."""
