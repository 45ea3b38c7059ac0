"""
What samples say of each other and of the clocks, and what was seen at each stop.

Reviews samples while they are taken, and tests whether other settings explain them better.
"""

OFFERED = (
    'clocks.require_same_clock', 'review.Agreement', 'review.FEWEST', 'review.Review',
    'review.flat_crossing', 'review.review', 'snapshots.stop_snapshot', 'snapshots.stop_snapshots',
    'summaries.calibration_summary', 'summaries.changes_since', 'summaries.count_of',
    'summaries.in_the_way', 'summaries.late_sentence', 'summaries.sample_summary',
    'summaries.with_trouble', 'wrong_settings.require_settings',
)
