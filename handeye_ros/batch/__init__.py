"""
Many recordings: one verb on all in parallel, on Dask, and their results over time.

Jobs, their results, one table and one report; the trend of calibrations, control charts of
verifications and checks.
"""

OFFERED = (
    'charts', 'errors.NoTrendError', 'jobs.Job', 'jobs.LOCKS', 'jobs.Row', 'report.cell_of',
    'report.cells_of', 'report.result_of', 'report.worst_answers', 'report.write_report',
    'run.client_of', 'run.jobs_of', 'run.rows_of', 'run.words_of', 'run.write_rows', 'trend',
)
