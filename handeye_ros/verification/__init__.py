"""Whether a calibration holds: routines on known artefacts, and checks of its own target."""
