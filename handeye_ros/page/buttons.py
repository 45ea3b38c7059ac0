"""Functions of the page: services, parameters, sessions and files of the node."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from handeye_ros import config as configuration
from handeye_ros.bags.reader import CLOUD, POSE
from handeye_ros.bags.session_reading import sessions_in
from handeye_ros.errors import HandeyeError
from handeye_ros.node.errors import NothingToSaveError
from handeye_ros.node.live import LiveSession
from handeye_ros.node.state import State
from handeye_ros.output import folder_name
from handeye_ros.page.contents import contents, stop_profile
from handeye_ros.results import calibration_file, exports
from handeye_ros.verification.routines import ROUTINES
from rclpy.parameter import Parameter

SERVICES = {'take': 'take_sample', 'undo': 'remove_last_sample', 'clear': 'clear_samples',
            'compute': 'compute_calibration', 'save': 'save_calibration',
            'verify': 'verify_start', 'verdict': 'verify_result'}
SLOW = frozenset({'compute', 'save', 'verdict', 'open', 'file'})
# Parameters that the page can set.
SETTINGS = ('profile_topic', 'pose_source', 'pose_topic', 'profile.unit', 'noise.robot_class',
            'target.radius', 'target.size', 'guidance.accuracy', 'sampling.mode')
VERIFY = ('verify.routine', 'verify.radius', 'verify.lengths', 'verify.reference',
          'verify.tolerance')

Act = Callable[[Mapping[str, Any]], tuple[bool, str]]
Read = Callable[[Mapping[str, str]], Any]


@dataclass(frozen=True)
class Source:
    """
    Content and actions of the page.

    state: returns plain values; acts: the buttons by name, each is called with the values of its
    request and returns success and message; slow: names of slow ones: the others do not wait for
    them; reads: by name, each is called with the values of its query and returns plain values, or
    name and text of a file.
    """

    state: Callable[[], Mapping[str, Any]]
    acts: Mapping[str, Act]
    slow: frozenset[str] = frozenset()
    reads: Mapping[str, Read] = field(default_factory=dict)


class Served(Protocol):
    """Interface of the node that the page needs."""

    live: LiveSession

    @property
    def state(self) -> State:
        """Return the current state of the session."""

    def topics_of(self, kind: str) -> list[str]:
        """Return the topics with publishers of a message type."""

    def call_service(self, name: str) -> tuple[bool, str]:
        """Return whether a service succeeds, and its message."""

    def open_session(self, name: str) -> str:
        """Continue a previous session; return the message. Raises HandeyeError."""

    def set_parameters(self, changes: list[Parameter]) -> Any:
        """Set parameters; see rclpy."""

    def get_logger(self) -> Any:
        """Return the log."""


def source(node: Served) -> Source:
    """Return content and actions of the page for a node."""
    return Source(lambda: contents(node.state, node.live), acts(node), SLOW, {
        'stop': lambda values: stop_profile(node.live, int(values.get('number', '0'))),
        'cell': lambda values: cell(node),
        'file': lambda values: file(node.live, values.get('name', ''))})


def acts(node: Served) -> dict[str, Act]:
    """Return the functions of the buttons."""
    services = {button: _service(node, name) for button, name in SERVICES.items()}
    return services | {'exclude': lambda values: _excluded(node, values, True),
                       'include': lambda values: _excluded(node, values, False),
                       'set': lambda values: _set(node, values),
                       'open': lambda values: _opened(node, str(values.get('session', '')))}


def cell(node: Served) -> dict[str, Any]:
    """Return the settings with their choices, and the names of the sessions."""
    parameters = {p.key: p for p in configuration.parameters()}
    values = configuration.flatten(node.live.config)
    choices = {'profile_topic': node.topics_of(CLOUD), 'pose_topic': node.topics_of(POSE),
               'verify.routine': list(ROUTINES)}
    live = node.live
    return {'sessions': [path.name for path in sessions_in(live.folders.folder(live.config))],
            'session': Path(live.samples.store.path).name,
            'settings': [{
                'key': key, 'value': values[key], 'description': parameters[key].description,
                'choices': choices.get(key, list(parameters[key].choices))}
                for key in (*SETTINGS, *VERIFY)]}


def file(live: LiveSession, name: str) -> tuple[str, str]:
    """Return name and text of a file of the answer; raises HandeyeError without one."""
    if live.calibration is None:
        raise NothingToSaveError
    calibration = calibration_file.dated(replace(
        live.calibration, name=folder_name(live.config)))
    if name == exports.REPORT:
        text = live.solver.run(report, calibration, live.samples.store.path, urgent=True)
        return name, text
    form = exports.format_of(name)
    return form.file_name(calibration), form.text(calibration)


def report(calibration: Any, session: str) -> str:
    """Return the report of a calibration and its session as HTML; takes seconds."""
    from handeye_ros.evidence import evidence
    from handeye_ros.results import pages  # matplotlib
    return pages.html(calibration, evidence(calibration, Path(session) if session else None))


def _service(node: Served, name: str) -> Act:
    return lambda values: node.call_service(name)


def _opened(node: Served, session: str) -> tuple[bool, str]:
    try:
        return True, node.open_session(session)
    except HandeyeError as error:
        return False, str(error)


def _set(node: Served, values: Mapping[str, Any]) -> tuple[bool, str]:
    """Set parameters given as YAML: all or none."""
    config, changes = node.live.config, []
    try:
        for key, text in values.items():
            if key not in (*SETTINGS, *VERIFY):
                return False, f'{key[:40]} is not set by the page'
            config = configuration.with_assignments(config, [f'{key}={text}'])
        after = configuration.flatten(config)
        changes = [Parameter(key, value=after[key]) for key in values]
    except HandeyeError as error:
        return False, str(error)
    for result in node.set_parameters(changes):
        if not result.successful:
            return False, result.reason
    return True, ', '.join(f'{key} is {after[key]}' for key in values)


def _excluded(node: Served, values: Mapping[str, Any], leave_out: bool) -> tuple[bool, str]:
    """Exclude a sample, or include it again."""
    number = values.get('number')
    if type(number) is not int or number not in {s.number for s in node.state.samples}:
        return False, f'there is no sample {str(number)[:20]}'
    other_numbers = [n for n in node.live.config.samples.exclude if n != number]
    numbers = sorted([*other_numbers, number]) if leave_out else other_numbers
    result, = node.set_parameters([Parameter('samples.exclude', Parameter.Type.INTEGER_ARRAY,
                                             numbers)])
    if not result.successful:
        return False, result.reason
    return True, (f'sample {number} is left out' if leave_out else f'sample {number} is back')
