# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the page shows, and what its buttons do: services, parameters, sessions and files."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, TYPE_CHECKING

from handeye_ros import config as configuration
from handeye_ros import se3
from handeye_ros.bags.session_files import read_session, sessions_in
from handeye_ros.bags.storage import CLOUD_TYPE, POSE_TYPE
from handeye_ros.calibration import edges_used
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Calibration, Sample, StopSnapshot
from handeye_ros.errors import InputError, looked_up
from handeye_ros.frames import mount_poses
from handeye_ros.guidance.candidates import anchor_of
from handeye_ros.guidance.first_moves import AdvisedMove
from handeye_ros.guidance.view import extremes
from handeye_ros.pipeline import Answer
from handeye_ros.results import exports, printed
from handeye_ros.results.scene import outline_of, profile_picture, rounded
from handeye_ros.review import stop_snapshot
from handeye_ros.targets import target_for
from handeye_ros.verification.result_file import reasons_and_figures, title_of
from handeye_ros.verification.routines import ROUTINES
import numpy as np

if TYPE_CHECKING:
    from handeye_ros.node.live import LiveSession
    from handeye_ros.node.node import HandeyeNode

# buttons that call the service of their name
PAGE_SERVICES = ('take_sample', 'clear_samples', 'compute_calibration', 'save_calibration',
                 'verify_start', 'verify_result')
# parameters that the page can set, with their labels in its forms
PAGE_SETTINGS = {
    'profile_topic': 'Topic of the profiles',
    'pose_source': 'Poses come from',
    'pose_topic': 'Topic of the flange poses',
    'profile.unit': 'Unit of the profiles',
    'noise.robot_class': 'Accuracy class of the robot',
    'target.radius': 'Radius of the sphere / m',
    'target.size': 'Lengths of the plate / m',
    'guidance.accuracy': 'Wanted accuracy (1 sigma) / m',
    'sampling.mode': '',  # has a place of its own
    'verify.routine': 'What is measured',
    'verify.radius': 'Radius / m',
    'verify.lengths': 'Nominal lengths / m',
    'verify.reference': 'Touched point x, y, z / m',
    'verify.tolerance': 'Largest error that passes / m'}

FEW_STOPS = 3  # of a session that has just begun, perhaps by itself after a restart
EXCLUDING = Lock()  # held while samples.exclude is read and set again

# the two kinds of functions of a PageSource
Action = Callable[[Mapping[str, Any]], tuple[bool, str]]
Query = Callable[[Mapping[str, str]], Any]


@dataclass(frozen=True)
class PageSource:
    """
    Content and actions of the page.

    state: returns plain values
    actions: the buttons by name, each is called with the values of its request and returns success
        and message, or raises HandeyeError
    queries: by name, each is called with the values of its query and returns plain values, or name
        and text of a file
    """

    state: Callable[[], Mapping[str, Any]]
    actions: Mapping[str, Action]
    queries: Mapping[str, Query]


def page_source(node: HandeyeNode) -> PageSource:
    """
    Return content and actions of the page for a node.

    Of the node they use live, of which a process makes the report, state(), streams.topics_of for
    the choices, call_service, set_values and open_session.
    """
    actions: dict[str, Action] = {
        **{name: partial(lambda name, _: node.call_service(name), name) for name in PAGE_SERVICES},
        # number: of that which the person has seen as the last
        'remove_last_sample': lambda values: node.call_service(
            'remove_last_sample', values.get('number')),
        'exclude': partial(_exclude, node), 'set': partial(_set, node),
        'open': lambda values: (True, node.open_session(str(values.get('session'))))}
    queries: dict[str, Query] = {
        'stop': lambda values: stop_profile(node.live, values.get('number', '')),
        'setup': lambda values: _setup(node),
        'file': lambda values: _file(node.live, values.get('name', ''))}
    return PageSource(lambda: contents(node), actions, queries)


def _exclude(node: HandeyeNode, values: Mapping[str, Any]) -> tuple[bool, str]:
    """Exclude a sample, or include it again."""
    number, excludes = values.get('number'), values.get('excluded') is True
    known_numbers = {stop.number for stop in node.live.session_copy().stops}
    if type(number) is not int or number not in known_numbers:
        return False, f'there is no sample {str(number)[:20]}'
    with EXCLUDING:
        excluded = {*node.live.config.samples.exclude} - {number}
        refusal = node.set_values(
            {'samples.exclude': sorted(excluded | ({number} if excludes else set()))})
    return not refusal, refusal or f'sample {number} is {"excluded" if excludes else "included"}'


def _set(node: HandeyeNode, values: Mapping[str, Any]) -> tuple[bool, str]:
    """Set parameters given as YAML: all or none."""
    if others := sorted(values.keys() - PAGE_SETTINGS.keys()):
        return False, f'{others[0][:40]} is not set by the page'
    settings = configuration.flatten(configuration.with_assignments(
        node.live.config, [f'{key}={text}' for key, text in values.items()]))
    refusal = node.set_values({key: settings[key] for key in values})
    return not refusal, refusal or ', '.join(f'{key} is {settings[key]}' for key in values)


def _setup(node: HandeyeNode) -> dict[str, Any]:
    """
    Return the settings with their choices, and the names of the sessions by last use.

    settings: key, label, value, description and choices of each, empty where any will do;
    previous: of a session that has just begun, the number of samples in the session before;
    nominal_keys: by routine, the keys that it asks for.
    """
    live = node.live
    values = configuration.flatten(live.config)
    parameters = {parameter.key: parameter for parameter in configuration.parameters()}
    choices = {'profile_topic': node.streams.topics_of(CLOUD_TYPE),
               'pose_topic': node.streams.topics_of(POSE_TYPE), 'verify.routine': [
                   name for name, routine in ROUTINES.items() if not routine.in_passes]}
    current = Path(live.path).name
    sessions = [path for path in sessions_in(live.folders.folder(live.config))
                if path.name != current]
    previous = 0
    if sessions and len(live.session_copy().stops) <= FEW_STOPS:
        with suppress(InputError):  # a damaged one; who opens it is told
            stored = read_session(sessions[0])  # none may fit the settings of then
            previous = stored.sample_count or len(stored.stops)
    settings = [{'key': key, 'label': label, 'value': values[key],
                 'description': parameters[key].description,
                 'choices': choices.get(key, list(parameters[key].choices))}
                for key, label in PAGE_SETTINGS.items()]
    return {'sessions': [path.name for path in sessions], 'previous': previous,
            'settings': settings,
            'nominal_keys': {name: routine.nominal_keys for name, routine in ROUTINES.items()}}


def _file(live: LiveSession, name: str) -> tuple[str, str]:
    """Return name and text of a file of the answer; raises HandeyeError without one."""
    calibration = live.solver.require_calibration()
    if name == exports.REPORT_FILE:
        return name, live.pool.submit(_report, calibration, live.files.path).result()
    file_format = looked_up('format', name, exports.FORMATS)
    return file_format.file_name(calibration), file_format.text(calibration)


def _report(calibration: Calibration, session: Path | None) -> str:
    """Return the report of a calibration and its session as HTML; takes seconds."""
    from handeye_ros.results.report import html
    from handeye_ros.review import solved_recording
    return html(calibration, solved_recording(calibration, session))


def contents(node: HandeyeNode) -> dict[str, Any]:
    """
    Return the content of the page as plain values, of one moment of the session.

    The state of the node (state.py), and: profile: the last one with its features, None without
    one; scene: for the picture in space; edges: by number, which each used sample shows;
    has_just_begun: there are few stops, perhaps of a session that a restart began; rows: of the
    answer, name, value, 1 sigma and unit as in the table of `handeye solve`;
    verification: what is running, in words, and whether another recording follows; verdict (pass,
    ...), title and figures of the last of this answer.
    """
    live, session = node.live, node.live.session_copy()
    samples = {stop.number: stop.sample for stop in session.stops if stop.sample}
    snapshot, calibration = live.current_snapshot(), live.solver.calibration
    checked = live.verification.result_of_current_answer
    return {**node.state(session), 'profile': snapshot and _picture(snapshot),
            'scene': _scene(live, samples, snapshot),
            'edges': _edges(live.solver.review.answer, samples),
            'has_just_begun': len(session.stops) <= FEW_STOPS,
            'rows': list(printed.transform_rows(calibration)) if calibration else [],
            'verification': {
                'running': live.verification.text,
                'next_recording': live.verification.has_next_recording,
                'verdict': checked.get('verdict', ''),
                'title': title_of(checked) if checked else '',
                'figures': reasons_and_figures(checked) if checked else ''}}


def stop_profile(live: LiveSession, number: str) -> dict[str, Any]:
    """Return a profile of a stop with its features; raises InputError for unknown stops."""
    for stop in live.session_copy().stops:
        if str(stop.number) == number:
            return _picture(stop_snapshot(stop, live.config))
    raise InputError(f'there is no stop {number}')


def _picture(snapshot: StopSnapshot) -> dict[str, Any]:
    """Return a profile with its features, or why it has none."""
    return {**profile_picture(snapshot.points, snapshot.features), 'reason': snapshot.reason}


def _edges(answer: Answer, samples: Mapping[int, Sample]) -> dict[int, str]:
    """Return the edges of the target that each used sample shows, a pass all of its profiles'."""
    if answer.solution is None:
        return {}
    number_by_stamp = {station.stamp: number for number, sample in samples.items()
                       for station in sample.station_samples}
    used = answer.solution.used_stations.tolist()
    edges: dict[int, dict[str, None]] = {}  # each once, in the order of the points
    for station, shown in zip(used, edges_used(answer.solution.problem), strict=True):
        number = number_by_stamp.get(answer.samples[station].stamp, 0)
        edges.setdefault(number, {}).update(dict.fromkeys(shown))
    return {number: ', '.join(shown) for number, shown in edges.items()}


def _scene(live: LiveSession, samples: Mapping[int, Sample], snapshot: StopSnapshot | None
           ) -> dict[str, Any]:
    """
    Return poses (rows of T (3, 4)) in the frame of the fixed target, and the target.

    known: whether the poses are of the sensor, or of the flange while the sensor's is unknown;
    now, next: the pose of now and the proposed one; samples: number and pose (T) of each; round:
    whether the target is a ball; range_sign: as in profile.range_sign; view: outline of the field
    of view in the sensor plane; aim: the motion to the next pose; move: the advice while the
    sensor's pose is unknown, each None without; edges, outline: polylines (n, 3) of the target;
    spots: (n, 3) points of it, one of each station; ball: its centre and radius, or None. Metres,
    in the frame that the target is fixed in.
    """
    config, advice = live.config, live.solver.review.advice
    answer = live.solver.review.answer
    solution = answer.solution if advice.sigmas else None
    T_flange_sensor = solution.estimate.X if solution else np.eye(4)
    pose, next_pose = live.last_pose, advice.next_pose.T_base_flange if advice.next_pose else None
    view = [live.solver.view, *([snapshot.points] if snapshot else [])]

    def as_rows(T_base_flange: Array | None) -> Any:
        return None if T_base_flange is None else rounded(
            (mount_poses(T_base_flange, config) @ T_flange_sensor)[:3])

    return {
        'known': solution is not None, 'range_sign': config.profile.range_sign,
        'round': Arc in target_for(config).required_features,
        'view': rounded(extremes(np.concatenate(view))), 'now': as_rows(pose),
        'samples': [{'number': number, 'T': as_rows(sample.T_base_flange)}
                    for number, sample in samples.items()],
        'next': as_rows(next_pose),
        'aim': None if pose is None or next_pose is None else _motion_to(pose, next_pose),
        'move': advice.move_from_first_pose and _advised_move(advice.move_from_first_pose),
        **(_target(answer, config) if solution else {
            'edges': [], 'outline': [], 'spots': [], 'ball': None})}


def _motion_to(T_base_flange: Array, T_base_next: Array) -> dict[str, Any]:
    """Return the motion to a pose: m along the axes of the base, rad about those of the flange."""
    turn = se3.log_rotation(T_base_flange[:3, :3].T @ T_base_next[:3, :3])
    shift = T_base_next[:3, 3] - T_base_flange[:3, 3]
    return {'shift': rounded(shift), 'turn': rounded(turn),
            'distance': float(np.linalg.norm(shift)), 'angle': float(np.linalg.norm(turn))}


def _advised_move(move: AdvisedMove) -> dict[str, Any]:
    """Return a move relative to the first pose; R: (3, 3) of the sensor after the move."""
    R = se3.exp_rotation(np.array([0.0, 0.0, move.turn])) @ se3.exp_rotation(
        np.append(move.tilt, 0.0))
    return {'turn': move.turn, 'tilt': rounded(move.tilt), 'place': rounded(move.place),
            'R': rounded(R)}


def _target(answer: Answer, config: Config) -> Mapping[str, Any]:
    """Return edges, outline and ball of the target, and a point (3,) for each station."""
    solution = answer.solution
    assert solution is not None
    problem, estimate = solution.problem, solution.estimate
    anchors = np.array([anchor_of(problem, i) for i in range(len(problem.poses))])
    sensor_points = np.insert(anchors, 1, 0.0, axis=1)  # (x, range) as (x, 0, range)
    points = se3.apply(problem.poses @ estimate.X, sensor_points[:, None])[:, 0]
    outline = outline_of(problem.target.describe(estimate.state, solution.target_std),
                         config.target.size, points)
    ball = outline.ball and (rounded(outline.ball[0]), outline.ball[1])
    return {'edges': [rounded(line) for line in outline.edges], 'ball': ball,
            'outline': [rounded(line) for line in outline.outline], 'spots': rounded(points)}
