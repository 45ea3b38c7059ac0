"""The verb that finds the robot's own error."""
from dataclasses import replace
from pathlib import Path
from typing import Annotated, TYPE_CHECKING

from handeye_ros.cli.app import app
from handeye_ros.cli.common import Assignments, ConfigFile, configuration, doing, show, warn
import typer

if TYPE_CHECKING:
    from handeye_ros.config import Config
    from handeye_ros.kinematics.answer import Answer
    from handeye_ros.kinematics.chain import Chain

TABLES = ('.csv', '.yaml', '.yml')


@app.command()
def kinematics(
    source: Annotated[Path, typer.Argument(metavar='SOURCE', help=(
        'A bag with profiles and joint values, or a table of joint values and measured points '
        '(CSV or YAML).'))],
    urdf: Annotated[Path, typer.Option(metavar='FILE', help='The URDF of the robot.')],
    base: Annotated[str, typer.Option(help='The link that the arm stands on; default: the root '
                                           'of the URDF.')] = '',
    flange: Annotated[str, typer.Option(help='The link that carries the sensor; default: tool0, '
                                             'flange, or the last link.')] = '',
    parameters: Annotated[list[str], typer.Option(
        '--with', metavar='KIND', help='Estimate more than offsets and axes: gear, eccentricity '
        'or sag; may be repeated.')] = [],  # noqa: B006 - never changed
    config: ConfigFile = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
    propose: Annotated[int, typer.Option(
        min=0, metavar='N', help='Write also programme.csv and programme.yaml '
        '(trajectory_msgs/JointTrajectory): N configurations that help most next.')] = 0,
    out: Annotated[Path, typer.Option(
        metavar='DIR', help='Where corrected.urdf, kinematics.yaml and calibration.yaml are '
                            'written.')] = Path('out/kinematics'),
) -> None:
    """Find the errors of the robot's joints and axes, together with the hand-eye transform."""
    settings = configuration(config, assignments)
    _require_kinds(parameters)
    from handeye_ros.kinematics.answer import save
    from handeye_ros.kinematics.chain import chain_of, read_urdf
    from handeye_ros.kinematics.screen import table
    text = read_urdf(urdf)
    chain = chain_of(text, base, flange, urdf)
    solve = _solve_table if source.suffix in TABLES and source.is_file() else _solve_bag
    found = solve(source, urdf, chain, parameters, settings)
    for warning in found.warnings:
        warn(warning)
    show(table(found))
    typer.echo(save(found, text, out, settings.save.formats))
    if propose:
        typer.echo(_proposed(found, propose, out))


def _require_kinds(kinds: list[str]) -> None:
    from handeye_ros.errors import UnknownNameError
    from handeye_ros.kinematics.model import ON_DEMAND
    for kind in kinds:
        if kind not in ON_DEMAND:
            raise UnknownNameError('kind of parameter', kind, ON_DEMAND)


def _solve_table(source: Path, urdf: Path, chain: 'Chain', more: list[str], settings: 'Config'
                 ) -> 'Answer':
    from handeye_ros.kinematics.outcome import answer_of, calibration_of, solve_points
    from handeye_ros.kinematics.samples import compared
    from handeye_ros.kinematics.table import read_table
    from handeye_ros.results.calibration_file import input_values
    data, odd = read_table(source, chain, settings.calibration_type == 'eye_in_hand')
    with doing('solving'):
        outcome = solve_points(data, chain, more, settings.limits.residual)
    calibration = calibration_of(outcome, data, settings)
    told = (*odd, *([] if data.reported is None else [
        compared(data.reported, chain.forward(data.q))]))
    return answer_of(outcome, calibration, [input_values(source), input_values(urdf)], told)


def _solve_bag(source: Path, urdf: Path, chain: 'Chain', more: list[str], settings: 'Config'
               ) -> 'Answer':
    from handeye_ros.cli.common import advancing
    from handeye_ros.kinematics.samples import solve_recording
    from handeye_ros.results.calibration_file import input_values
    from handeye_ros.ros.bags.bag import read_with_joints
    with advancing('reading the recording') as progress:
        recording = read_with_joints(source, settings, chain, progress)
    inputs = [*recording.inputs, input_values(urdf)]
    with doing('solving'):
        return solve_recording(replace(recording, inputs=inputs), chain, more, settings)


def _proposed(found: 'Answer', count: int, out: Path) -> str:
    """Write the configurations that help most next; return what they promise."""
    from handeye_ros.kinematics.programme import as_csv, as_trajectory, programme
    from handeye_ros.results.calibration_file import write_whole
    made, chain = programme(found.fit, count), found.arm.chain
    write_whole(out / 'programme.csv', as_csv(chain, made.q))
    write_whole(out / 'programme.yaml', as_trajectory(chain, made.q))
    return (f'wrote programme.csv and programme.yaml: {len(made.q)} configurations; with them '
            f'points in other postures are predicted to {made.after * 1e3:.3f} mm (1 sigma), '
            f'now {made.before * 1e3:.3f} mm')
