"""
What is refused and named before an answer is given.

Motion, conventions, moves of the target, shape, misfit: each raises an error that says what
to do. Knows samples and estimates, and no file and no message.
"""

OFFERED = (
    'alternatives.Fit', 'alternatives.Hypothesis', 'alternatives.range_sign_evidence',
    'alternatives.require_stated', 'consistency.require_answer', 'consistency.require_certain',
    'consistency.require_own_frame', 'consistency.require_rotations',
    'consistency.require_solvable', 'conventions.require_agreement', 'errors.ConventionError',
    'errors.CountedWrongWayError', 'errors.LeftOutError', 'errors.TooUncertainError',
    'shape.believable_shape', 'shape.notes_of', 'shape.offset_notes', 'shape.reported_blocks',
    'shape.require_one_scale', 'shape.time_offset_of',
)
