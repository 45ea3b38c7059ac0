"""
What samples say of each other and of the clocks, and what was seen at each stop.

Reviews samples while they are taken, and tests whether other settings explain them better.
"""

OFFERED = (
    'review.Agreement', 'review.FEWEST', 'review.flat_crossing', 'review.review', 'review.Review',
    'settings.require_same_clock', 'settings.require_settings', 'summaries.calibration_summary',
    'summaries.changes_since', 'summaries.count_of', 'summaries.in_the_way',
    'summaries.late_sentence', 'summaries.sample_summary', 'summaries.stop_snapshot',
    'summaries.stop_snapshots', 'summaries.with_trouble',
)
