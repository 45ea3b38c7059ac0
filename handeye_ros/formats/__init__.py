"""
Files on disk: calibration.yaml, truth.yaml, the result of a verification, exported formats.

Knows what is in a file and how it is written, not how its values were found.
"""

OFFERED = (
    'calibration_file', 'calibration_file.file_of', 'calibration_file.input_values',
    'calibration_file.read_calibration', 'calibration_file.transform_from',
    'calibration_file.transform_values', 'calibration_file.write_calibration',
    'errors.CalibrationFileError', 'export_formats', 'exports', 'truth_file', 'truth_file.Errors',
    'truth_file.FIELD', 'truth_file.errors_against', 'truth_file.field_points',
    'truth_file.true_transform', 'verification_file.COLUMNS', 'verification_file.FORMAT',
    'verification_file.Verified', 'verification_file.content_of', 'verification_file.formatted',
    'verification_file.read', 'verification_file.rows_of', 'verification_file.title_of',
)
