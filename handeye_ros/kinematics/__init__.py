"""
The robot's own error: joints and axes that differ from its URDF.

Found with the same target; answers are a corrected URDF and a calibration that fits it.
"""

OFFERED = (
    'answer.Answer', 'answer.solve_table', 'errors.ContradictionError',
    'errors.TooFewConfigurationsError', 'model.Arm', 'model.Chain', 'model.JointNamesError',
    'model.ON_DEMAND', 'programme.programme', 'report.table', 'report.write_page',
    'samples.JointRecording', 'samples.Source', 'samples.solve_sources',
    'samples.source_of', 'urdf.read_arm', 'urdf.read_chain',
)
