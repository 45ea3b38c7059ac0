"""
Many recordings: one verb on all in parallel, on Dask, and their results over time.

Jobs, their results, one table and one report; the trend of calibrations.
"""
