"""
What is refused and named before an answer is given.

Motion, conventions, moves of the target, shape, misfit: each raises an error that says what
to do. Knows samples and estimates, and no file and no message.
"""

OFFERED = (
    'alternatives.Fit', 'alternatives.Hypothesis', 'alternatives.believable',
    'alternatives.of_problem', 'alternatives.require_stated', 'change_point.moved_slightly',
    'conventions.require_conventions', 'conventions.require_range_sign', 'errors.ConventionError',
    'errors.CountedWrongWayError', 'errors.LeftOutError', 'errors.OneAxisError',
    'errors.OneOrientationError', 'errors.TooUncertainError', 'misfit.edge_notes',
    'misfit.require_consistent', 'misfit.require_edges', 'misfit.residual_rms',
    'motion.SMALLEST_TURN', 'motion.frame_notes', 'motion.name_direction', 'motion.other_axes',
    'motion.require_certain', 'motion.require_judged', 'motion.require_own_frame',
    'motion.require_rotations', 'motion.require_samples', 'motion.turning', 'motion.weakest',
    'motion.worst_rotation', 'motion.worst_translation', 'shape.ROTATION_LAG', 'shape.TIME_OFFSET',
    'shape.believable_shape', 'shape.contradictions', 'shape.offset_notes',
    'shape.reported_blocks', 'shape.require_one_scale', 'shape.time_offset_of',
)
