"""The verb that tells how calibrations, verifications and checks went through time."""
from pathlib import Path
from typing import Annotated

from handeye_ros.cli.common import app, NoPath, show, warn
import typer

Folder = Annotated[Path, typer.Argument(
    metavar='DIR', help='The folder below which all calibration.yaml, and the YAML files of '
    'verify and check (--out), are taken.')]
Against = Annotated[NoPath, typer.Option(
    metavar='FILE', help='The calibration that the others are compared with; default: the '
    'oldest.')]
Picture = Annotated[NoPath, typer.Option(metavar='FILE', help='Draw it (needs matplotlib).')]
Csv = Annotated[NoPath, typer.Option(
    metavar='FILE', help='Write the calibrations as CSV, and what was measured beside it '
    '(FILE_measured).')]


@app.command()
def trend(folder: Folder, against: Against = None, picture: Picture = None, csv: Csv = None
          ) -> None:
    """Tell how the calibrations, verifications and checks below a folder went through time."""
    from functools import partial

    from handeye_ros.output import write_whole
    from handeye_ros.results.calibration_file import read_calibration
    from handeye_ros.verification import charts
    from handeye_ros.verification import trend as trends
    from handeye_ros.verification.errors import NoTrendError
    measured, bad = charts.charts(folder)
    try:
        entries, warnings = trends.trend(folder, read_calibration(against) if against else None)
    except NoTrendError:
        if not measured:
            raise
        entries, warnings = [], []
    for warning in (*warnings, *bad):
        warn(warning)
    if entries:
        show(trends.table(entries))
        typer.echo(trends.since_when(entries))
    if measured:
        show(charts.charts_table(measured))
    files = {csv: trends.csv_text(entries) if entries else ''} if csv else {}
    if csv and measured:
        files[csv.with_stem(f'{csv.stem}_measured')] = charts.charts_csv(measured)
    for file, text in files.items():
        if text:
            write_whole(file, text)
            typer.echo(f'wrote {file.absolute()}')
    if picture:
        trends.draw(entries, picture, [partial(charts.draw_chart, one) for one in measured])
        typer.echo(f'wrote {picture.absolute()}')
