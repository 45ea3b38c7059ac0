"""
What is shown and written of an answer.

The table, calibration.yaml, truth.yaml, the outcome in figures; exports and the report in
rooms of their own.
"""

OFFERED = (
    'calibration_file', 'calibration_file.file_of', 'calibration_file.input_values',
    'calibration_file.read_calibration', 'calibration_file.transform_from',
    'calibration_file.transform_values', 'calibration_file.write_calibration',
    'errors.CalibrationFileError', 'errors.NothingToSaveError', 'folder', 'outcome.Measured',
    'outcome.NuisanceReport', 'outcome.describe_calibration', 'outcome.left_out',
    'outcome.measured_points', 'protocol.html',
    'table', 'target_shape.enlargement', 'target_shape.half_axes', 'target_shape.rings',
    'target_shape.shape', 'truth_file.Errors', 'truth_file.FIELD',
    'truth_file.errors_against', 'truth_file.field_points', 'truth_file',
    'truth_file.true_transform', 'verified.COLUMNS', 'verified.FORMAT', 'verified.Verified',
    'verified.read', 'verified.rows_of', 'verified.shown', 'verified.title_of', 'verified.written',
)
