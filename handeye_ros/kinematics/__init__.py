"""
Kinematic calibration of the robot: joints and axes that differ from its URDF.

The data are those of a hand-eye calibration with joint values; the answer is a corrected URDF with
the calibration that belongs to it.
"""

OFFERED = (
    'answer.Answer', 'answer.solve_table', 'errors.ContradictionError',
    'errors.TooFewConfigurationsError', 'model.Arm', 'model.Chain', 'model.JointNamesError',
    'model.ON_DEMAND', 'programme.programme', 'report.table', 'report.write_page',
    'samples.JointRecording', 'samples.Source', 'samples.solve_sources',
    'samples.source_of', 'urdf.read_arm', 'urdf.read_chain',
)
