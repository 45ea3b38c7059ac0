"""The buttons of the page: the services of the node, and the parameter samples.exclude."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, TYPE_CHECKING

from handeye_ros.ros.errors import PageError
from handeye_ros.ros.node.live import LiveSession
from handeye_ros.ros.page.contents import contents
from handeye_ros.sampling.state import State
from rclpy.parameter import Parameter

if TYPE_CHECKING:
    from handeye_ros.ros.page.server import Act, PageServer

SERVICES = {'take': 'take_sample', 'undo': 'remove_last_sample', 'clear': 'clear_samples',
            'compute': 'compute_calibration', 'save': 'save_calibration'}
SLOW = frozenset({'compute', 'save'})
EXCLUDE = 'samples.exclude'


class Served(Protocol):
    """The node, as far as the page knows it."""

    live: LiveSession

    @property
    def token_file(self) -> Path:
        """Return the file that keeps the token of the page."""

    @property
    def state(self) -> State:
        """Return all that is told of the session."""

    def ask(self, service: Any) -> tuple[bool, str]:
        """Return whether a service succeeds, and what it says."""

    def set_parameters(self, changes: list[Parameter]) -> Any:
        """Set parameters; see rclpy."""

    def get_logger(self) -> Any:
        """Return the log."""


def serve(node: Served) -> PageServer | None:
    """Serve the page of a node if its configuration wants one; None, and a warning, if not."""
    config, log = node.live.config.page, node.get_logger()
    if not config.port:
        return None
    from handeye_ros.ros.page.server import PageServer, Source  # aiohttp takes long to import
    source = Source(lambda: contents(node.state, node.live), acts(node), SLOW)
    try:
        file = node.token_file
        page = PageServer(source, config.address, config.port, file)
    except PageError as error:
        log.warning(str(error))
        return None
    log.info(f'page for a browser: {page.url}' + (
        f'; it asks for the token in {file}' if page.guard.token else ''))
    return page


def acts(node: Served) -> dict[str, Act]:
    """Return what each button does."""
    found: dict[str, Act] = {name: _service(node, service) for name, service in SERVICES.items()}
    return found | {'exclude': lambda values: _excluded(node, values, True),
                    'include': lambda values: _excluded(node, values, False)}


def _service(node: Served, name: str) -> Act:
    return lambda values: node.ask(getattr(node, name))


def _excluded(node: Served, values: Mapping[str, Any], leave_out: bool) -> tuple[bool, str]:
    """Leave a sample out, or bring it back."""
    number = values.get('number')
    if type(number) is not int or number not in {s.number for s in node.state.samples}:
        return False, f'there is no sample {str(number)[:20]}'
    others = [n for n in node.live.config.samples.exclude if n != number]
    numbers = sorted([*others, number]) if leave_out else others
    result, = node.set_parameters([Parameter(EXCLUDE, Parameter.Type.INTEGER_ARRAY, numbers)])
    if not result.successful:
        return False, result.reason
    return True, (f'sample {number} is left out' if leave_out else f'sample {number} is back')
