"""Many recordings through one verb, in parallel: jobs, their results, one table and report."""
