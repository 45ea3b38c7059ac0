"""Which recordings a batch takes: bags, folders and lists of them, local or by URL."""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import csv
from dataclasses import replace
import io
from pathlib import Path, PurePosixPath
import shlex

from handeye_ros.batch.errors import JobListError, NoJobsError
from handeye_ros.batch.jobs import files_below, is_remote, Job
import yaml

BAGS = ('.mcap', '.db3')
LISTS = ('.csv', '.yaml', '.yml')
COLUMNS = {'bag', 'label', 'config', 'settings', 'args'}


def jobs_of(sources: Sequence[str], base: Job) -> list[Job]:
    """
    Return the jobs of bags, folders of bags, and CSV or YAML lists; base: what they share.

    Raises JobListError, NoJobsError.
    """
    jobs: list[Job] = []
    for source in sources:
        if source.endswith(LISTS) and Path(source).is_file():
            jobs += _listed(Path(source), base)
        else:
            jobs += [replace(base, bag=bag, label=label)
                     for bag, label in _bags_in(source, several=len(sources) > 1)]
    if not jobs:
        raise NoJobsError(' '.join(sources))
    seen: dict[str, int] = {}
    unique = []
    for job in jobs:
        seen[job.label] = seen.get(job.label, 0) + 1
        number = seen[job.label]
        unique.append(job if number == 1 else replace(job, label=f'{job.label}-{number}'))
    return unique


def _bags_in(source: str, several: bool) -> Iterator[tuple[str, str]]:
    """Yield the bags that a path or a URL is or holds, and their names; several: of folders."""
    below = files_below(source)
    if below is None and not is_remote(source) and not Path(source).exists():
        raise NoJobsError(source)
    if below is None or 'metadata.yaml' in below:
        yield _absolute(source), PurePosixPath(source).stem
        return
    files = {PurePosixPath(file) for file in below}
    folders = {file.parent for file in files if file.name == 'metadata.yaml'}
    single = {file for file in files if file.suffix in BAGS and file.parent not in folders}
    for bag in sorted(folders | single):
        name = bag.with_suffix('')
        yield (f'{_absolute(source).rstrip("/")}/{bag}',
               str(PurePosixPath(source).name / name if several else name))


def words_of(text: str, folder: Path) -> tuple[str, ...]:
    """Return the words of a command; files in a folder by their absolute path, for workers."""
    return tuple(str((folder / word).absolute()) if (folder / word).is_file() else word
                 for word in shlex.split(text))


def _absolute(source: str | Path) -> str:
    return str(source) if is_remote(str(source)) else str(Path(source).absolute())


def _listed(path: Path, base: Job) -> Iterable[Job]:
    """Return the jobs of a list, whose paths are relative to it."""
    try:
        text = path.read_text(encoding='utf-8')
        rows = (list(csv.DictReader(io.StringIO(text), skipinitialspace=True))
                if path.suffix == '.csv' else yaml.safe_load(text))
        for row in rows:
            if 'bag' not in row or not COLUMNS.issuperset(row):
                raise JobListError(path, f'it has {", ".join(map(str, row))}')
            settings = row.get('settings') or ''
            assignments = settings.split() if isinstance(settings, str) else [
                f'{k}={v}' for k, v in settings.items()]
            bag = row['bag'] if is_remote(row['bag']) else _absolute(path.parent / row['bag'])
            config = row.get('config')
            yield replace(
                base, bag=bag, label=str(row.get('label') or PurePosixPath(bag).stem),
                config=str((path.parent / config).absolute()) if config else base.config,
                settings=(*base.settings, *assignments),
                args=(*base.args, *words_of(row.get('args') or '', path.parent)))
    except (OSError, KeyError, TypeError, AttributeError, ValueError, yaml.YAMLError) as error:
        raise JobListError(path, f'{type(error).__name__}: {error}') from error
