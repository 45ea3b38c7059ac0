"""The verb that finds the robot's own error."""
from pathlib import Path
from typing import Annotated, TYPE_CHECKING

from handeye_ros.cli.app import app
from handeye_ros.cli.common import Assignments, ConfigFile, configuration, doing, show, warn
import typer

if TYPE_CHECKING:
    from handeye_ros.config import Config
    from handeye_ros.kinematics.answer import Answer


@app.command()
def kinematics(
    source: Annotated[Path, typer.Argument(metavar='SOURCE', help=(
        'A table of joint values and measured points (CSV or YAML).'))],
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
    out: Annotated[Path, typer.Option(
        metavar='DIR', help='Where corrected.urdf, kinematics.yaml and calibration.yaml are '
                            'written.')] = Path('out/kinematics'),
) -> None:
    """Find the errors of the robot's joints and axes, together with the hand-eye transform."""
    settings = configuration(config, assignments)
    from handeye_ros.errors import UnknownNameError
    from handeye_ros.kinematics.chain import chain_of, read_urdf
    from handeye_ros.kinematics.model import ON_DEMAND
    from handeye_ros.kinematics.outcome import answer_of, solve
    from handeye_ros.kinematics.screen import table
    from handeye_ros.kinematics.table import read_table
    from handeye_ros.results.calibration_file import input_values
    for kind in parameters:
        if kind not in ON_DEMAND:
            raise UnknownNameError('kind of parameter', kind, ON_DEMAND)
    text = read_urdf(urdf)
    chain = chain_of(text, base, flange, urdf)
    data, odd = read_table(source, chain, settings.calibration_type == 'eye_in_hand')
    inputs = [input_values(source), input_values(urdf)]
    with doing('solving'):
        found = answer_of(solve(data, chain, parameters, settings.limits.residual), settings,
                          inputs)
    for warning in (*odd, *found.warnings):
        warn(warning)
    show(table(found))
    typer.echo(_saved(found, text, out, settings))


def _saved(found: 'Answer', urdf: str, out: Path, settings: 'Config') -> str:
    """Write an answer into a folder; return what was written."""
    from handeye_ros.kinematics import answer as answers
    from handeye_ros.results import exports
    from handeye_ros.results.calibration_file import write_whole
    lost = answers.only_in_yaml(found.arm)
    if lost:
        warn(f'no URDF can hold {" and ".join(lost)}: corrected.urdf is without them, '
             'kinematics.yaml has them')
    saved = exports.save_all(found.calibration, out, settings.save.formats)
    write_whole(out / answers.NAME, answers.text(found))
    write_whole(out / answers.URDF, answers.corrected_urdf(urdf, found.arm))
    return f'{saved}, {answers.NAME}, {answers.URDF}'
