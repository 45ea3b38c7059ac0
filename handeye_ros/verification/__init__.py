"""
Whether a calibration holds.

Routines on known artefacts, checks of its own target, and the trend of several.
"""

OFFERED = (
    'charts', 'check', 'check.Check', 'errors.NoAnswerError', 'errors.NoTrendError',
    'errors.NotStartedError', 'errors.NothingToCheckError', 'errors.NothingToVerifyError',
    'errors.UnusableStopError', 'plan', 'routines.ROUTINES', 'routines.Routine', 'routines.TEETH',
    'routines.routine_of', 'session.VerificationSession', 'shapes.Seen',
    'tooth_gauge.seen_in_pass', 'trend', 'verification', 'verification.Verification',
    'verify.seen_in', 'verify.settings_for', 'verify.verify',
)
