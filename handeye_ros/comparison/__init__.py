"""
The same samples through every estimator, side by side.

Ours, the published ones, and those of files; each is judged on stations that it did not use.
"""

OFFERED = ('compare', 'table')
