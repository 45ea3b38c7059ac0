"""
Residuals of samples, wrong settings and clocks, and what was seen at each stop.

Reviews samples while they are taken, and tests whether other settings explain them better.
"""

OFFERED = (
    'review.Agreement', 'review.count_of', 'review.FEWEST', 'review.flat_crossing',
    'review.review', 'review.Review', 'review.sample_summary', 'review.stop_snapshot',
    'review.stop_snapshots', 'settings.require_same_clock', 'settings.require_settings',
)
