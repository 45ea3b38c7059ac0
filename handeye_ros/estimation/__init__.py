"""
The stated model of the estimator (docs/estimator.md) and its solution.

Problem, nuisance parameters, noise, one solver, robust start, covariance. Names no target:
a target gives its conditions and blocks through `model`.
"""

OFFERED = (
    'basis.bent_surface', 'basis.process_in_time', 'basis.process_root', 'blocks.Blocks',
    'blocks.ParameterBlock', 'consensus.Consensus', 'linalg.covariance_of', 'linearise.Linear',
    'linearise.linearise', 'linearise.Problem', 'model.Conditions', 'model.Estimate',
    'model.FeatureModel', 'model.Geometry', 'model.Measures', 'model.Method', 'model.Nuisances',
    'model.Observations', 'model.PoseModel', 'model.UNUSED', 'noise.Noise', 'noise.prior_scales',
    'noise.TURN_LENGTH', 'noise.whitening', 'outliers.adjust', 'outliers.Adjusted',
    'outliers.chi2_isf', 'outliers.chi2_sf', 'outliers.FALSE_ALARM',
    'outliers.first_variances', 'outliers.leave_one_out', 'outliers.outliers',
    'outliers.variance_components', 'posterior.evaluated', 'posterior.reestimated',
    'search.best_of', 'search.CONVINCING', 'search.different', 'search.fit',
    'search.relabelled', 'solution.covering', 'solution.Solution',
    'solver.believed', 'solver.graduated', 'solver.Rows', 'solver.System', 'solver.White',
)
