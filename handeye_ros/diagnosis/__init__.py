"""
What samples say of each other and of the clocks, and what was seen at each stop.

Reviews samples while they are taken, and tests whether other settings explain them better.
"""

OFFERED = (
    'review.Agreement', 'review.FEWEST', 'review.Review', 'review.flat_crossing',
    'review.review', 'settings.require_same_clock', 'settings.require_settings',
    'summaries.count_of', 'summaries.sample_summary', 'summaries.stop_snapshot',
    'summaries.stop_snapshots',
)
