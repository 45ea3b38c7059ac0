"""
Many recordings through one verb, in parallel, on Dask.

Jobs, their results, one table and one report; a worker that ends loses one try of one job.
"""

OFFERED = (
    'jobs.Job', 'jobs.LOCKS', 'jobs.Row', 'report.cell_of', 'report.cells_of', 'report.result_of',
    'report.worst_answers', 'report.write_report', 'run.client_of', 'run.rows_of',
    'run.write_rows', 'run.jobs_of', 'run.words_of',
)
