"""The verb of kinematic calibration."""
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, TYPE_CHECKING

from handeye_ros.cli.common import (
    advancing,
    app,
    Assignments,
    configuration,
    doing,
    show,
    stored_session,
    TABLES,
    warn,
)
from handeye_ros.errors import HandeyeError
import typer

if TYPE_CHECKING:
    from handeye_ros.config import Config
    from handeye_ros.data import TimedPose
    from handeye_ros.robot.answer import Answer
    from handeye_ros.robot.model import Chain
    from handeye_ros.robot.samples import Source


@app.command()
def kinematics(
    sources: Annotated[list[Path], typer.Argument(metavar='SOURCE...', help=(
        'A bag with profiles and joint values, a session, or a table of joint values and measured '
        'points (CSV or YAML). Several bags or sessions, each with a target at another place, are '
        'solved together.'))],
    urdf: Annotated[Path, typer.Option(metavar='FILE', help='The URDF of the robot.')],
    base: Annotated[str, typer.Option(help='The link that the arm stands on; default: the root '
                                           'of the URDF.')] = '',
    flange: Annotated[str, typer.Option(help='The link that carries the sensor; default: tool0, '
                                             'flange, or the last link.')] = '',
    configs: Annotated[list[Path], typer.Option(
        '--config', metavar='FILE', help='A ROS parameter file, for all sources; or one for each '
        'of them, in their order.')] = [],  # noqa: B006 - never changed
    assignments: Assignments = [],  # noqa: B006 - never changed
    out: Annotated[Path, typer.Option(
        metavar='DIR', help='Where corrected.urdf, kinematics.yaml and calibration.yaml are '
                            'written.')] = Path('out/kinematics'),
) -> None:
    """Find the errors of the robot's joints and axes, together with the hand-eye transform."""
    files = _for_each(sources, configs)
    settings = configuration(files[0], assignments)
    from handeye_ros.robot.report import table
    from handeye_ros.robot.urdf import read_chain
    text, chain = read_chain(urdf, base, flange)
    answer = (_solve_table(sources[0], urdf, chain, settings) if _table(sources) else
              _solve_profiles(zip(sources, files, strict=True), urdf, chain, assignments))
    for warning in answer.warnings:
        warn(warning)
    show(table(answer))
    typer.echo(answer.save(text, out, settings.save.formats))


def _table(sources: list[Path]) -> bool:
    """Return whether the source is a table; there may be only one."""
    tables = [source for source in sources if source.suffix in TABLES and source.is_file()]
    if tables and len(sources) > 1:
        raise typer.BadParameter('give one table only: its column "target" names several '
                                 'points')
    return bool(tables)


def _for_each(sources: list[Path], configs: list[Path]) -> Sequence[Path | None]:
    """Return the configuration file of each source."""
    if len(configs) not in (0, 1, len(sources)):
        raise typer.BadParameter(f'{len(configs)} --config for {len(sources)} sources: give one '
                                 'for all of them, or one for each')
    return configs if len(configs) == len(sources) else [*configs, None][:1] * len(sources)


def _solve_table(source: Path, urdf: Path, chain: 'Chain', settings: 'Config') -> 'Answer':
    from handeye_ros.results.calibration_file import input_values
    from handeye_ros.robot.answer import solve_table
    with doing('solving'):
        return solve_table(source, chain, settings,
                           [input_values(source), input_values(urdf)])


def _solve_profiles(paths: Iterable[tuple[Path, Path | None]], urdf: Path, chain: 'Chain',
                    assignments: list[str]) -> 'Answer':
    from handeye_ros.results.calibration_file import input_values
    from handeye_ros.robot.samples import solve_sources
    sources = [_source(path, chain, config, assignments) for path, config in paths]
    with doing('solving'):
        return solve_sources(sources, chain, [input_values(urdf)])


def _source(path: Path, chain: 'Chain', config: Path | None, assignments: list[str]) -> 'Source':
    """Return the samples of a bag or a session; the settings of a session are the default."""
    from handeye_ros.bags.bag import read, read_poses
    from handeye_ros.bags.session_reading import source_of_session
    from handeye_ros.robot.model import Arm
    from handeye_ros.robot.samples import JointRecording, source_of
    stored = stored_session(path)
    settings = configuration(config, assignments, stored.config if stored else None)
    if stored:
        return source_of_session(stored, settings, chain)
    with advancing('reading the recording') as progress:
        recording = read(path, settings, progress, Arm(chain))
    reported: Sequence[TimedPose] = ()
    with suppress(HandeyeError):
        reported = read_poses(path, replace(settings, kinematics='')).poses
    assert recording.joints is not None
    joints = JointRecording(recording.profiles, recording.poses, recording.joints, reported,
                            recording.warnings, recording.inputs)
    with doing('finding the stops'):
        return source_of(joints, chain, settings)
