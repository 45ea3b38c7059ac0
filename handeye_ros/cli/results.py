"""The verbs that make of a saved calibration what others read."""
from pathlib import Path
from typing import Annotated

from handeye_ros.cli.common import app, doing, NoPath
from handeye_ros.config import SAVE_FORMATS
import typer

Saved = Annotated[Path, typer.Argument(
    metavar='CALIBRATION', help='A calibration.yaml, or the folder that holds it.')]


@app.command()
def export(
    path: Saved,
    name: Annotated[str, typer.Option(
        '--format', autocompletion=lambda: list(SAVE_FORMATS),
        help=f'One of {", ".join(SAVE_FORMATS)}.')],
    out: Annotated[NoPath, typer.Option(metavar='FILE', help=(
        'The file to write, - for the screen; if not given, one beside the calibration.'))] = None,
) -> None:
    """Write a saved calibration for other programs: URDF, launch file, shell line, ..."""
    from handeye_ros.results import exports
    from handeye_ros.results.calibration_file import file_of, read_calibration
    form, file = exports.of(name), file_of(path)
    calibration = read_calibration(file)
    if str(out) == '-':
        typer.echo(form.text(calibration), nl=False)
        return
    target = out or file.parent / form.file_name(calibration)
    typer.echo(exports.export(calibration, name, target))


@app.command()
def report(
    path: Saved,
    bag: Annotated[NoPath, typer.Option(
        metavar='BAG', help='The recording; if not given, the one the calibration names.')] = None,
    out: Annotated[NoPath, typer.Option(
        metavar='FILE', help='If not given, report.html beside the calibration.')] = None,
    verification: Annotated[list[Path], typer.Option(
        metavar='FILE', help='A result of "handeye verify --out" to show too; may be repeated.'
    )] = [],  # noqa: B006 - never changed
) -> None:
    """Show a saved calibration, or a verification, and what it comes from in one HTML file."""
    from handeye_ros.output import write_whole
    from handeye_ros.results.calibration_file import file_of, read_calibration
    from handeye_ros.results.protocol import html as protocol
    from handeye_ros.results.report import page
    from handeye_ros.results.verified import read
    from handeye_ros.results.verified import written as verification_in
    from handeye_ros.ros.bags.bag import evidence
    if path.is_file() and (values := verification_in(path)):
        html = (out or path.with_suffix('.html')).absolute()
        write_whole(html, protocol(values))
        typer.echo(f'wrote {html}')
        return
    file, verified = file_of(path), [read(one) for one in verification]
    calibration = read_calibration(file)
    with doing('finding the stops'):
        found = evidence(calibration, bag)
    with doing('writing the report'):
        written = page.write(calibration, found, out or file.parent / page.NAME,
                             verified)
    typer.echo(f'wrote {written}')
