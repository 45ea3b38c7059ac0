"""The application that the verbs belong to, and what becomes of errors in all of them."""
from typing import Annotated, Any

from handeye_ros import __version__
from handeye_ros.errors import HandeyeError
import typer
from typer.core import TyperGroup

INTERRUPTED = 130


class Verbs(TyperGroup):
    """The one place where errors become a sentence and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Run a verb."""
        try:
            return super().invoke(ctx)
        except HandeyeError as error:
            typer.echo(f'error: {" ".join(str(error).split())}', err=True)
            raise typer.Exit(error.exit_code) from None
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None


app = typer.Typer(cls=Verbs, no_args_is_help=True, rich_markup_mode=None,
                  pretty_exceptions_enable=False)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f'handeye_ros {__version__}')
        raise typer.Exit


@app.callback()
def _options(version: Annotated[bool, typer.Option(
        '--version', callback=_print_version, is_eager=True,
        help='Print the version and exit.')] = False) -> None:
    """Hand-eye calibration of laser line profilers."""
