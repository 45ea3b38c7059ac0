"""
The stated model of the estimator (docs/estimator.md) and its solution.

Problem, nuisance parameters, noise, one solver, robust start, covariance. Names no target:
a target gives its conditions and blocks through `model`.
"""

OFFERED = (
    'basis.bent_surface', 'basis.pose_features', 'basis.process_in_time', 'basis.process_root',
    'blocks.Blocks', 'blocks.ParameterBlock', 'blocks.by_twists', 'blocks.tolerances',
    'consensus.Consensus', 'consensus.SUBSETS', 'consensus.consensus', 'consensus.fast_consensus',
    'consensus.refine', 'influence.predictions', 'linalg.covariance_of', 'linalg.covering',
    'linearise.Linear', 'linearise.Problem', 'linearise.linearise', 'linearise.points_at',
    'linearise.points_in_base', 'model.Conditions', 'model.Estimate', 'model.FeatureModel',
    'model.Geometry', 'model.Measures', 'model.Method', 'model.Nuisances', 'model.Observations',
    'model.PoseModel', 'model.UNUSED', 'noise.Noise', 'noise.TURN_LENGTH', 'noise.Whitening',
    'noise.covariances', 'noise.lumped', 'noise.whitening', 'outliers.Adjusted', 'outliers.adjust',
    'outliers.chi2_isf', 'outliers.chi2_sf', 'outliers.f_isf', 'outliers.leave_one_out',
    'outliers.outliers', 'posterior.BELIEF_NOISE', 'posterior.evaluated', 'scales.Scales',
    'scales.first_variances', 'scales.prior_scales', 'scales.variance_components',
    'search.FEW_STATIONS', 'search.best_of', 'search.different', 'search.guesses',
    'search.relabelled', 'search.shows_essential', 'solution', 'solution.Solution',
    'solution.corrected_poses', 'solution.redundancy', 'solution.retracted',
    'solver.Rows', 'solver.System', 'solver.White', 'solver.as_they_are', 'solver.believed',
    'solver.graduated', 'solver.least_squares', 'solver.reweighted',
)
