"""
The robot's own error: joints and axes that differ from its URDF.

Found with the same target; answers are a corrected URDF and a calibration that fits it.
"""

OFFERED = (
    'answer.Answer', 'answer.calibration_of', 'answer.read_arm', 'answer.save', 'chain.Chain',
    'chain.chain_of', 'chain.read_urdf', 'errors.ContradictionError', 'errors.JointNamesError',
    'errors.TooFewConfigurationsError', 'model.Arm', 'model.ON_DEMAND', 'outcome.solve_points',
    'points.read_table', 'programme.as_csv', 'programme.as_trajectory', 'programme.programme',
    'report.sentence', 'report.table', 'report.write_page', 'samples.JointRecording',
    'samples.Source', 'samples.compared', 'samples.configured', 'samples.solve_sources',
    'samples.source_of',
)
