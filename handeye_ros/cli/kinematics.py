"""The verb of kinematic calibration."""
from collections.abc import Iterable, Sequence
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
import typer

if TYPE_CHECKING:
    from handeye_ros.config import Config
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
    parameters: Annotated[list[str], typer.Option(
        '--with', metavar='KIND', help='Estimate more than offsets and axes: gear, eccentricity '
        'or sag; may be repeated.')] = [],  # noqa: B006 - never changed
    configs: Annotated[list[Path], typer.Option(
        '--config', metavar='FILE', help='A ROS parameter file, for all sources; or one for each '
        'of them, in their order.')] = [],  # noqa: B006 - never changed
    assignments: Assignments = [],  # noqa: B006 - never changed
    propose: Annotated[int, typer.Option(
        min=0, metavar='N', help='Write also programme.csv and programme.yaml '
        '(trajectory_msgs/JointTrajectory): N configurations that help most next.')] = 0,
    out: Annotated[Path, typer.Option(
        metavar='DIR', help='Where corrected.urdf, kinematics.yaml and calibration.yaml are '
                            'written.')] = Path('out/kinematics'),
) -> None:
    """Find the errors of the robot's joints and axes, together with the hand-eye transform."""
    files = _for_each(sources, configs)
    settings = configuration(files[0], assignments)
    _require_kinds(parameters)
    from handeye_ros.robot.urdf import read_chain
    text, chain = read_chain(urdf, base, flange)
    answer = (_solve_table(sources[0], urdf, chain, parameters, settings) if _table(sources) else
              _solve_profiles(zip(sources, files, strict=True), urdf, chain, parameters,
                              assignments))
    _write(answer, text, out, settings)
    if propose:
        typer.echo(_proposed(answer, propose, out))


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


def _write(answer: 'Answer', urdf: str, out: Path, settings: 'Config') -> None:
    from handeye_ros.robot.report import table, write_page
    for warning in answer.warnings:
        warn(warning)
    show(table(answer))
    typer.echo(answer.save(urdf, out, settings.save.formats))
    write_page(answer, out)


def _require_kinds(kinds: list[str]) -> None:
    from handeye_ros.errors import UnknownNameError
    from handeye_ros.robot.model import ON_DEMAND
    for kind in kinds:
        if kind not in ON_DEMAND:
            raise UnknownNameError('kind of parameter', kind, ON_DEMAND)


def _solve_table(source: Path, urdf: Path, chain: 'Chain', extra_kinds: list[str],
                 settings: 'Config') -> 'Answer':
    from handeye_ros.results.calibration_file import input_values
    from handeye_ros.robot.answer import solve_table
    with doing('solving'):
        return solve_table(source, chain, extra_kinds, settings,
                           [input_values(source), input_values(urdf)])


def _solve_profiles(paths: Iterable[tuple[Path, Path | None]], urdf: Path, chain: 'Chain',
                    extra_kinds: list[str], assignments: list[str]) -> 'Answer':
    from handeye_ros.results.calibration_file import input_values
    from handeye_ros.robot.samples import solve_sources
    sources = [_source(path, chain, config, assignments) for path, config in paths]
    with doing('solving'):
        return solve_sources(sources, chain, extra_kinds, [input_values(urdf)])


def _source(path: Path, chain: 'Chain', config: Path | None, assignments: list[str]) -> 'Source':
    """Return the samples of a bag or a session; the settings of a session are the default."""
    from handeye_ros.bags.bag import read_with_joints
    from handeye_ros.bags.session_reading import source_of_session
    from handeye_ros.robot.samples import source_of
    stored = stored_session(path)
    settings = configuration(config, assignments, stored.config if stored else None)
    if stored:
        return source_of_session(stored, settings, chain)
    with advancing('reading the recording') as progress:
        recording = read_with_joints(path, settings, chain, progress)
    with doing('finding the stops'):
        return source_of(recording, chain, settings)


def _proposed(answer: 'Answer', count: int, out: Path) -> str:
    """Write the most useful next configurations; return their predicted gain."""
    from handeye_ros.output import write_whole
    from handeye_ros.robot.programme import programme
    proposal = programme(answer.outcome.models[-1].fit, count)
    write_whole(out / 'programme.csv', proposal.as_csv())
    write_whole(out / 'programme.yaml', proposal.as_trajectory())
    before, after = (f'{error * 1e3:.3f} mm' for error in proposal.errors[[0, -1]])
    count = len(proposal.q)
    enough = f'{proposal.enough} are enough' if proposal.enough <= count else 'propose more'
    return (f'wrote programme.csv and programme.yaml: {count} configurations; with them points in '
            f'other postures are predicted to {after} (1 sigma), now {before}; {enough} to get '
            'below the residual of the points')
