"""The verbs that play and make recordings."""
from pathlib import Path
from typing import Annotated

from handeye_ros.cli.common import app, Bag, doing
from handeye_ros.errors import NoRosError, UnknownNameError
import typer


@app.command()
def replay(
    bag: Bag,
    rate: Annotated[float, typer.Option(help='Speed; 1 is as recorded.')] = 1.0,
) -> None:
    """Publish a recording on its topics, with /clock (needs ROS)."""
    try:
        from handeye_ros.node.replay import replay as publish
    except ModuleNotFoundError as error:
        raise NoRosError('replay', str(error.name)) from error
    publish(bag, rate)


def _scenarios() -> dict[str, str]:
    """Return the descriptions of scenarios by name."""
    from handeye_ros.simulate import FAULTS, FILE_SCENES, SCENARIOS
    from handeye_ros.simulate.measuring import MEASURING_CELL
    return {**{name: scenario.description for name, scenario in SCENARIOS.items()},
            **dict.fromkeys(FILE_SCENES, 'files of measured values'),
            **{name: scenario.description for name, scenario in FAULTS.items()},
            MEASURING_CELL: 'a calibration, and a recording for each routine of verify'}


def _print_scenarios(requested: bool) -> None:
    if requested:
        for name, description in _scenarios().items():
            typer.echo(f'{name:32} {description}')
        raise typer.Exit


@app.command()
def simulate(
    scenario: Annotated[str, typer.Argument(help='The name of a scenario; see --list.',
                                            autocompletion=lambda: list(_scenarios()))],
    directory: Annotated[Path, typer.Argument(
        metavar='DIR', help='The folder to make: a bag, or files of measured values.')],
    seed: Annotated[int, typer.Option(min=0, help='Of all random numbers.')] = 0,
    force: Annotated[bool, typer.Option('--force', help='Replace a bag that is there.')] = False,
    listed: Annotated[bool, typer.Option(
        '--list', callback=_print_scenarios, is_eager=True,
        help='Print all scenarios, and what differs from a plain recording, and exit.')] = False,
) -> None:
    """Make a recording with a known answer, which is written to truth.yaml in it."""
    if scenario not in _scenarios():
        raise UnknownNameError('scenario', scenario, list(_scenarios()),
                               'handeye simulate --list')

    from handeye_ros.cli import simulated
    with doing('simulating'):
        content = simulated.write(scenario, seed, directory, force)
    typer.echo(f'wrote {directory.absolute()}: {content}')
