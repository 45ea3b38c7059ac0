"""Refusals of a batch, and of the trend of its results."""
from __future__ import annotations

from handeye_ros.errors import DataError, InputError


class NoDaskError(InputError):
    """A batch without the libraries of its extra."""

    def __init__(self, name: str) -> None:
        super().__init__(f'batch needs {name}, which is not installed: pip install '
                         '"handeye_ros[batch]"')


class NoSchedulerError(InputError):
    """A scheduler that does not respond."""

    def __init__(self, address: str) -> None:
        super().__init__(f'no Dask scheduler answers at {address}: start one with "dask '
                         'scheduler" and workers with "dask worker ADDRESS --nthreads 1"')


class BadMemoryError(InputError):
    """An invalid memory limit."""

    def __init__(self, text: str) -> None:
        super().__init__(f'"{text}" is no size of memory: give one such as 2GB or 500MB, or auto')


class JobListError(InputError):
    """A list of jobs that cannot be read."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path}: {reason}; expected a CSV or YAML list with bag and, if wanted, '
                         'label, config, settings, args')


class NoJobsError(DataError):
    """Sources without a recording."""

    def __init__(self, sources: object) -> None:
        super().__init__(f'no recording in {sources}: give bags, folders of bags, or a CSV or '
                         'YAML list of them')


class RemoteError(InputError):
    """A URL that cannot be read."""

    def __init__(self, url: str, reason: str) -> None:
        super().__init__(f'{url} cannot be read ({reason}): check the URL, its credentials, and '
                         'that the library of its file system (such as s3fs) is installed')


class NoTrendError(DataError):
    """A folder with too few calibrations to compare."""

    def __init__(self, folder: object, count: int) -> None:
        super().__init__(f'{folder} holds {count} readable calibration.yaml, and no two files of '
                         'the same verification or check: a trend needs two of a kind (one '
                         'calibration with --against)')
