"""
The stated model of the estimator (docs/estimator.md) and its solution.

Problem, nuisance parameters, noise, robust start, covariance. Names no target:
a target gives its conditions and blocks through `model`.
"""

OFFERED = (
    'basis.bent_surface', 'basis.process_in_time', 'basis.process_root', 'blocks.Blocks',
    'blocks.ParameterBlock', 'consensus.Consensus', 'linearise.Linear', 'linearise.Problem',
    'linearise.linearise', 'model.Conditions', 'model.Estimate', 'model.FeatureModel',
    'model.Geometry', 'model.Measures', 'model.Method', 'model.Nuisances', 'model.Observations',
    'model.PoseModel', 'model.UNUSED', 'noise.Noise', 'noise.TURN_LENGTH', 'noise.prior_scales',
    'noise.whitening', 'posterior.evaluated', 'posterior.reestimated', 'search.CONVINCING',
    'search.best_of', 'search.different', 'search.fit', 'search.relabelled', 'solution.Solution',
    'solution.covering',
)
