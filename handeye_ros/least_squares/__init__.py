"""
Least squares, its covariance and its outliers: knows nothing of sensors, robots and targets.

The estimator, the robot's kinematics, tables of measured values and verifications solve with it.
"""

OFFERED = (
    'covariance.FREE', 'covariance.covariance_of', 'covariance.eigen',
    'covariance.from_information', 'covariance.from_rows', 'covariance.inverse',
    'covariance.inverse_roots', 'outliers.Adjusted', 'outliers.FALSE_ALARM', 'outliers.GROSS',
    'outliers.adjust', 'outliers.chi2_isf', 'outliers.chi2_sf', 'outliers.first_variances',
    'outliers.groups', 'outliers.leave_one_out', 'outliers.leave_own_out', 'outliers.outliers',
    'outliers.shared_scale', 'outliers.variance_components', 'solver.BELIEVED_SHARE',
    'solver.Rows', 'solver.States', 'solver.System', 'solver.White', 'solver.believed',
    'solver.graduated', 'solver.many_least_squares', 'solver.single_threaded',
)
