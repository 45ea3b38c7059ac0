"""What an answer says: its quality, the evidence for it, table and HTML report."""

OFFERED = (
    'evidence.Evidence', 'evidence.StopSnapshot', 'evidence.config_of', 'evidence.evidence_of',
    'evidence.recording_of', 'evidence.stated_noise', 'evidence.use_config', 'outcome.Measured',
    'outcome.NuisanceReport', 'outcome.describe_calibration', 'outcome.left_out',
    'outcome.measured_points', 'pages', 'scene.enlargement', 'scene.half_axes', 'scene.in_sensor',
    'scene.shape', 'table',
)
