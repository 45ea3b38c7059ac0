"""Verification of a calibration: routines on known artefacts, and checks on its own target."""

OFFERED = (
    'check', 'check.Check', 'check.FORMAT', 'errors.NoAnswerError', 'errors.NotStartedError',
    'errors.NothingToCheckError', 'errors.NothingToVerifyError', 'errors.UnusableStopError',
    'plan', 'routines.ROUTINES', 'routines.Routine', 'routines.TEETH', 'routines.routine_of',
    'session.VerificationSession', 'shapes.StationSet', 'tooth_gauge.stations_of_pass',
    'verification', 'verification.Verification', 'verification.time_of', 'verify.stations_of',
    'verify.settings_for', 'verify.verify',
)
