# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The node `handeye`: topics, services and parameters around a running session."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from handeye_ros import config as configuration
from handeye_ros.bags.session_files import (
    OutputFolders,
    PARAMETERS,
    read_session,
    settings_and_session,
    StoredSession,
)
from handeye_ros.config import Config, EVERY_NODES, Parameter, RECORD_NAMES, RECORD_PREFIX
from handeye_ros.errors import InputError, sentence_and_log, without_numbers
from handeye_ros.node.live import LiveSession
from handeye_ros.node.outputs import Outputs
from handeye_ros.node.pool import Pool
from handeye_ros.node.state import State, state_of, troubles_of, with_trouble
from handeye_ros.node.streams import Streams
from handeye_ros.output import folder_name
from handeye_ros.sampling.session import Session
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import HistoryPolicy, QoSProfile
from std_msgs.msg import Empty
from std_srvs.srv import SetBool, Trigger

CURRENT_PERIOD = 0.2  # s between two messages on ~/current
# they may wait for a solve; ROS keeps ten
REQUEST_QOS = QoSProfile(history=HistoryPolicy.KEEP_ALL)
SLOW_SERVICES = ('compute_calibration', 'verify_result')  # no other service waits for these
# Keys that cannot change while the node runs.
FIXED_KEYS = ('robot_base_frame', 'robot_effector_frame', 'session', 'page.port', 'page.address')
# Keys that a new session, and the class of the robot, set.
FOLLOWING_KEYS = ('samples.exclude', 'noise.robot_smooth')
# Keys of targets that are solved from files alone: no parameters.
FILES_ONLY = ('tracker.', 'sensor_frame')


class HandeyeNode(Node):
    """
    Takes samples of stops, and computes, publishes and saves calibrations on request.

    live: the session
    outputs: what is published of it
    streams: the subscriptions of now; others follow when topics change
    """

    def __init__(self) -> None:
        """Subscribe and serve; raises InputError for an invalid configuration."""
        super().__init__('handeye')
        folders = OutputFolders(self.get_namespace())
        config, stored = declare(self, folders)
        self.live = LiveSession(config, folders, Pool(), self._show_changes)
        live, answer, verification = self.live, self.live.answer, self.live.verification
        self._requests: dict[str, Callable[[], Any]] = {work.__name__: work for work in (
            live.take_sample, live.remove_last_sample, live.clear_samples,
            answer.compute_calibration, answer.save_calibration,
            verification.verify_start, verification.verify_result)}
        self.outputs = Outputs(self, live)
        self._warned: set[str] = set()  # warnings in the log
        self.add_on_set_parameters_callback(self._on_set)
        if stored:
            self.get_logger().info(live.open(stored, config))
        elif config.session:
            self.get_logger().warning(f'there is no session in {folders.parent(config)}: a new '
                                      'one begins')
        self.streams = Streams(self, live, live.add_joints)
        self.outputs.show()
        live.start()
        self._serve()
        self.get_logger().info(f'waiting for profiles on {config.profile_topic}, poses on '
                               f'{config.pose_origin[0]}')
        if config.page.port:
            from handeye_ros.page.server import serve  # aiohttp takes long to import
            serve(self)

    def _serve(self) -> None:
        quick = MutuallyExclusiveCallbackGroup()
        for name in self._requests:
            group = MutuallyExclusiveCallbackGroup() if name in SLOW_SERVICES else quick
            self.create_service(Trigger, f'~/{name}', partial(self._on_trigger, name),
                                callback_group=group, qos_profile=REQUEST_QOS)
        self.create_service(SetBool, '~/auto_sample', self._auto_sample, callback_group=quick,
                            qos_profile=REQUEST_QOS)
        self.create_subscription(Empty, '~/take', lambda _: self.call_service('take_sample'), 10,
                                 callback_group=quick)
        # steady time: the state is published even while a simulated clock is paused
        for period, work in ((1.0, self._diagnose),
                             (CURRENT_PERIOD, self.outputs.show_current)):
            self.create_timer(period, work, MutuallyExclusiveCallbackGroup(),
                              clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _show_changes(self) -> None:
        """Publish what the worker has changed, parameters that follow from others too."""
        self.outputs.show()
        values = configuration.flatten(self.live.config)
        told = _values(self.get_parameters(FOLLOWING_KEYS))
        if changed := {key: values[key] for key in FOLLOWING_KEYS if told[key] != values[key]}:
            self.set_values(changed)

    @property
    def state(self) -> State:
        """Return the current state of the session."""
        return state_of(self.live, self.streams.disturbances())

    def _diagnose(self) -> None:
        """Publish the state, and log the warnings that are new but for their numbers."""
        state = self.state
        self.outputs.diagnose(state)
        warnings = {without_numbers(sentence): sentence
                    for sentence in (*troubles_of(state), *state['session']['notes'])}
        for kind in warnings.keys() - self._warned:
            self.get_logger().warning(warnings[kind])
        self._warned = set(warnings)

    # services, which the page calls too

    def call_service(self, name: str) -> tuple[bool, str]:
        """Return whether a service succeeds, and its message, without the troubles of now."""
        try:
            answer = self.live.ask(self._requests[name])
            text, success = answer.result() if isinstance(answer, Future) else answer, True
            if name == 'clear_samples':
                self.streams.restart()
        except Exception as error:  # noqa: BLE001 - the node, and what it holds, must go on
            text, success = sentence_and_log(name, error), False
        if name != 'take_sample':  # which is in the log as an attempt
            log = self.get_logger()
            log.info(text) if success else log.warning(f'{name}: {text}')
        return success, text

    def open_session(self, name: str) -> str:
        """Continue a previous session with the current settings; raises HandeyeError."""
        live = self.live
        path = live.folders.folder(live.config) / Path(name).name
        if path == live.files.path:
            return f'{path} is the current session'
        stored = read_session(path)
        config = replace(live.config, samples=stored.config.samples)
        return live.ask(partial(live.open, stored, config))

    def set_values(self, values: Mapping[str, Any]) -> str:
        """Set parameters by key, all or none; return why one is refused, '' if all are set."""
        result = self.set_parameters_atomically([
            # ROS gives an empty list no type
            RosParameter(key, RosParameter.Type.INTEGER_ARRAY, value) if value == [] else
            RosParameter(key, value=value) for key, value in values.items()])
        return '' if result.successful else str(result.reason)

    def _on_trigger(self, name: str, _: Trigger.Request, response: Trigger.Response
                    ) -> Trigger.Response:
        response.success, text = self.call_service(name)
        response.message = with_trouble(self.state, text, response.success, name)
        return response

    def _auto_sample(self, request: SetBool.Request, response: SetBool.Response
                     ) -> SetBool.Response:
        refusal = self.set_values({'sampling.mode': 'still' if request.data else 'manual'})
        response.success, response.message = not refusal, refusal or (
            'a sample is taken at every stop of the robot' if request.data else
            'samples are taken by ~/take_sample only')
        return response

    # parameters

    def _on_set(self, changes: list[RosParameter]) -> SetParametersResult:
        """Apply changed parameters; ROS keeps the values before where that is refused."""
        reason = ''
        try:
            values = _values(changes)
            # not asked are changes of the worker itself, and those of ROS such as use_sim_time
            if self._with(values) != self.live.config:
                self.live.ask(partial(self._apply, values))
        except Exception as error:  # noqa: BLE001 - whoever sets it wants to know
            reason = sentence_and_log('the change', error)
        return SetParametersResult(successful=not reason, reason=reason)

    def _with(self, values: Mapping[str, Any]) -> Config:
        return configuration.with_values(self.live.config, values, PARAMETERS)

    def _apply(self, values: Mapping[str, Any]) -> None:
        """Apply changed settings; raises InputError. For the worker: one after the other."""
        config, live, session = self._with(values), self.live, self.live.session
        _check_names(config)
        last = session.last_number
        for number in {*config.samples.exclude} - {*live.config.samples.exclude}:
            if number > last:
                raise InputError(f'there is no sample {number} to exclude: the last stop is {last}'
                                 '; ~/samples lists all')
        other_topics = self.streams.names_other_topics(config)
        if other_topics and session.stops:
            raise InputError('the topics cannot change while there are stops from them: call '
                             '~/clear_samples first, which begins a new session')
        if other_topics:
            self.streams.stop()
        live.configure(config, other_topics)
        if other_topics:
            self.streams = Streams(self, live, live.add_joints)


def declare(node: Node, folders: OutputFolders) -> tuple[Config, StoredSession | None]:
    """
    Declare all parameters; return the configuration and the session to continue.

    Types are dynamic, so that 3 is accepted for 3.0; config.py checks every value. Raises
    UnknownKeyError and BadValueError for the user's settings, InputError for a session that cannot
    be read.
    """
    # rclpy offers no other access to the values of parameter files and arguments
    config, stored = settings_and_session(_values(node._parameter_overrides.values()), folders)
    _check_names(config)
    values, record = configuration.flatten(config), dict(config.record)
    free = ParameterDescriptor(description='Free text, kept with the answer.', dynamic_typing=True)
    node.declare_parameters('', [
        *((one.key, values[one.key], _descriptor(one)) for one in configuration.parameters()
          if not one.key.startswith(FILES_ONLY)),
        *((f'{RECORD_PREFIX}{name}', record.get(name, ''), free)
          for name in dict.fromkeys((*RECORD_NAMES, *record)))], ignore_override=True)
    return config, stored


def _values(ros_parameters: Iterable[RosParameter]) -> dict[str, Any]:
    """Return values by key, without those that every node has; raises InputError."""
    values = {}
    for p in ros_parameters:
        if p.name.startswith(FILES_ONLY):
            raise InputError(f'{p.name} is a key of the command line alone: leave it out')
        if not p.name.startswith(EVERY_NODES):
            # ROS gives an empty list no type, and other lists as arrays
            value = [] if p.type_ == RosParameter.Type.NOT_SET else p.value
            values[p.name] = value if isinstance(value, str | int | float) else list(value)
    return values


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return the descriptor shown by `ros2 param describe`."""
    texts = [f'{what} {" or ".join(map(str, values))}' for what, values in (
        ('number of values:', parameter.length), ('one of', parameter.choices)) if values]
    result = ParameterDescriptor(description=parameter.description, dynamic_typing=True,
                                 read_only=parameter.key in FIXED_KEYS,
                                 additional_constraints='; '.join(texts))
    low, high = parameter.minimum, parameter.maximum
    if low is not None and high is not None:  # rqt_reconfigure makes sliders of them
        if isinstance(parameter.default, int):
            result.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            result.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return result


def _check_names(config: Config) -> None:
    """Raise BadValueError for names of methods and folders that would fail later."""
    Session(config)
    folder_name(config)
