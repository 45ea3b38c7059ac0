"""Output of an answer: table, calibration.yaml, truth.yaml, export formats, HTML report."""

OFFERED = (
    'calibration_file', 'calibration_file.file_of', 'calibration_file.input_values',
    'calibration_file.read_calibration', 'calibration_file.transform_from',
    'calibration_file.transform_values', 'calibration_file.write_calibration',
    'errors.CalibrationFileError', 'errors.NothingToSaveError', 'evidence.Evidence',
    'evidence.StopSnapshot', 'evidence.config_of', 'evidence.evidence_of', 'evidence.recording_of',
    'evidence.stated_noise', 'evidence.use_config', 'exports', 'figures.style',
    'outcome.Measured', 'outcome.NuisanceReport', 'outcome.describe_calibration',
    'outcome.left_out', 'outcome.measured_points', 'pages', 'scene.enlargement',
    'scene.half_axes', 'scene.in_sensor', 'scene.shape', 'table', 'truth_file',
    'truth_file.Errors', 'truth_file.FIELD', 'truth_file.errors_against',
    'truth_file.field_points', 'truth_file.true_transform', 'verified.COLUMNS', 'verified.FORMAT',
    'verified.content_of', 'verified.formatted', 'verified.read', 'verified.rows_of',
    'verified.title_of',
)
