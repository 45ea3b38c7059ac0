"""
What is refused and named before an answer is given.

Motion, conventions, moves of the target, shape, misfit: each raises an error that says what
to do. Knows samples and estimates, and no file and no message.
"""

OFFERED = (
    'alternatives.believable', 'alternatives.Fit', 'alternatives.Hypothesis',
    'alternatives.of_problem', 'alternatives.range_sign_evidence',
    'alternatives.require_range_sign', 'alternatives.require_stated',
    'change_point.moved_slightly', 'consistency.edge_notes', 'consistency.require_certain',
    'consistency.require_consistent', 'consistency.require_edges', 'consistency.require_judged',
    'consistency.require_own_frame', 'consistency.require_rotations',
    'consistency.require_samples', 'conventions.require_conventions', 'errors.ConventionError',
    'errors.CountedWrongWayError', 'errors.LeftOutError', 'errors.TooUncertainError',
    'shape.believable_shape', 'shape.contradictions', 'shape.offset_notes',
    'shape.reported_blocks', 'shape.require_one_scale', 'shape.time_offset_of',
)
