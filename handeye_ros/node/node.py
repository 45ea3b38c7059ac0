# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The node `handeye`: topics, services and parameters around a running session."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from handeye_ros import config as configuration
from handeye_ros.bags.session_files import read_session, StoredSession
from handeye_ros.config import Config, Parameter, RECORD_NAMES, RECORD_PREFIX, ROS_OWN_PARAMETERS
from handeye_ros.errors import InputError, sentence_and_log
from handeye_ros.node.folders import OutputFolders, PARAMETER_SOURCE, settings_and_session
from handeye_ros.node.live import LiveSession
from handeye_ros.node.outputs import Outputs
from handeye_ros.node.pool import Pool
from handeye_ros.node.state import State, state_of, troubles_of, with_troubles
from handeye_ros.node.streams import log_new_warnings, Streams
from handeye_ros.output import folder_name, write_errors_for
from handeye_ros.sampling.session import Session
from handeye_ros.targets import target_for
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

DIAGNOSTICS_PERIOD = 1.0  # s between two messages on /diagnostics
CURRENT_PERIOD = 0.2  # s between two messages on ~/current
# they may wait for a solve; ROS keeps ten
REQUEST_QOS = QoSProfile(history=HistoryPolicy.KEEP_ALL)
# others wait for the stops that these evaluate first, but not for what they compute
SLOW_SERVICES = ('compute_calibration', 'verify_result')
# keys that the node sets itself: for a new session, and by noise.robot_class
DERIVED_KEYS = ('samples.exclude', 'noise.robot_smooth')
# beginnings of keys of targets that are solved from files alone: no parameters
FILES_ONLY = ('tracker.', 'sensor_frame')


class HandeyeNode(Node):
    """
    Takes samples of stops, and computes, publishes and saves calibrations on request.

    live: the session, which does all of that without ROS
    outputs: what is published of it
    streams: the subscriptions of now; others follow when topics change
    """

    def __init__(self) -> None:
        """Subscribe and serve; raises InputError for settings that cannot be used."""
        super().__init__('handeye')
        folders = OutputFolders(self.get_namespace())
        config, stored = declare_settings(self, folders)
        with write_errors_for(f'{folders.root(config)} (output_dir)'):
            folders.root(config).mkdir(parents=True, exist_ok=True)
            TemporaryFile(dir=folders.root(config)).close()
        self.live = live = LiveSession(config, folders, Pool(), self._publish_changes)
        self.outputs = Outputs(self, live)
        self._logged_warnings: set[str] = set()  # without their numbers
        self.add_on_set_parameters_callback(self._on_set_parameters)
        if stored:
            self.get_logger().info(live.open_session(stored, config))
        elif config.session:
            self.get_logger().warning(f'there is no session in {folders.root(config)} (of '
                                      'name, where it is set): a new one begins')
        self.streams = Streams(self, live, live.add_joints)
        live.restart_streams = lambda: self.streams.restart()
        self.outputs.publish_changes()
        live.start()
        self._offer_services()
        # steady time: the state is published even while a simulated clock is paused
        for period, publish in ((DIAGNOSTICS_PERIOD, self._publish_diagnostics),
                                (CURRENT_PERIOD, self.outputs.publish_current)):
            self.create_timer(period, publish, MutuallyExclusiveCallbackGroup(),
                              clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info(f'waiting for profiles on {config.profile_topic}, poses on '
                               f'{config.topic_of_poses}')
        if config.page.port:
            from handeye_ros.page.server import serve  # aiohttp takes long to import
            serve(self)

    def state(self, session: Session | None = None) -> State:
        """Return the current state; session: the copy to tell it of, else a new one."""
        return state_of(self.live, self.streams.graph_troubles(), session)

    # what is published

    def _publish_changes(self) -> None:
        """Publish what the worker has changed, and set the derived parameters."""
        self.outputs.publish_changes()
        settings = configuration.flatten(self.live.config)
        declared = _values_by_key(self.get_parameters(DERIVED_KEYS))
        if changed := {key: settings[key] for key in declared if declared[key] != settings[key]}:
            self.set_values(changed)

    def _publish_diagnostics(self) -> None:
        """Publish the state, and log new warnings."""
        state = self.state()
        self.outputs.publish_diagnostics(state)
        self._logged_warnings = log_new_warnings(
            self, [*troubles_of(state), *state['session']['warnings']], self._logged_warnings)

    # services, which the page calls too

    def _offer_services(self) -> None:
        """Offer the services of the node, and take a sample for each message on ~/take."""
        live, solver, verification = self.live, self.live.solver, self.live.verification
        self._trigger_functions: dict[str, Callable[..., str | Future[str]]] = {
            function.__name__: function for function in (
                live.take_sample, live.remove_last_sample, live.clear_samples,
                solver.compute_calibration, solver.save_calibration,
                verification.verify_start, verification.verify_result)}
        quick = MutuallyExclusiveCallbackGroup()
        for name in self._trigger_functions:
            group = MutuallyExclusiveCallbackGroup() if name in SLOW_SERVICES else quick
            self.create_service(Trigger, f'~/{name}', partial(self._on_trigger, name),
                                callback_group=group, qos_profile=REQUEST_QOS)
        self.create_service(SetBool, '~/auto_sample', self._on_auto_sample, callback_group=quick,
                            qos_profile=REQUEST_QOS)
        self.create_subscription(Empty, '~/take', lambda _: self.call_service('take_sample'), 10,
                                 callback_group=quick)

    def call_service(self, name: str, *values: Any) -> tuple[bool, str]:
        """
        Return whether a service succeeds, and its message, without the troubles of now.

        The page shows these beside the message, which stays when they are over; values: what it
        adds to the request.
        """
        try:
            reply = self.live.worker.call(partial(self._trigger_functions[name], *values),
                                          then_publish=True)
            message, success = reply.result() if isinstance(reply, Future) else reply, True
        except Exception as error:  # noqa: BLE001 - the node, and what it holds, must go on
            message, success = sentence_and_log(name, error), False
        if name != 'take_sample':  # which is in the log as an attempt
            log = self.get_logger()
            log.info(message) if success else log.warning(f'{name}: {message}')
        return success, message

    def _on_trigger(self, name: str, _: Trigger.Request, response: Trigger.Response
                    ) -> Trigger.Response:
        """Answer a request of a service: success, and the message with the current troubles."""
        response.success, message = self.call_service(name)
        response.message = with_troubles(self.state(), message, response.success, name)
        return response

    def _on_auto_sample(self, request: SetBool.Request, response: SetBool.Response
                        ) -> SetBool.Response:
        """Answer a request of ~/auto_sample: set sampling.mode to still (true) or manual."""
        mode = 'still' if request.data else 'manual'
        refusal = self.set_values({'sampling.mode': mode})
        response.success, response.message = not refusal, refusal or f'sampling.mode is {mode}'
        return response

    def open_session(self, name: str) -> str:
        """
        Continue a previous session with the current settings, but its own samples.exclude.

        Returns the message; raises HandeyeError.
        """
        live, name = self.live, Path(name).name
        path = live.folders.folder(live.config) / name
        if path == live.files.path:
            return f'{name} is open already'
        stored = read_session(path)

        def go_on() -> str:  # with the settings at the worker's turn
            return live.open_session(stored, replace(live.config, samples=stored.config.samples))
        return live.worker.call(go_on, then_publish=True)

    # parameters

    def set_values(self, values: Mapping[str, Any]) -> str:
        """Set parameters by key, all or none; return why one is refused, '' if all are set."""
        result = self.set_parameters_atomically([
            # ROS gives an empty list no type
            RosParameter(key, RosParameter.Type.INTEGER_ARRAY, value) if value == [] else
            RosParameter(key, value=value) for key, value in values.items()])
        return '' if result.successful else str(result.reason)

    def _on_set_parameters(self, changes: list[RosParameter]) -> SetParametersResult:
        """Apply changed parameters; ROS keeps the values before where that is refused."""
        reason = ''
        try:
            for change in changes:
                if change.type_ == RosParameter.Type.NOT_SET:
                    raise InputError(f'{change.name} cannot be deleted: set it to a value')
            values = _values_by_key(changes)
            # parameters of ROS itself (use_sim_time) change nothing, nor do derived keys, which
            # the worker sets: it must not wait for itself
            if self._config_with(values) != self.live.config:
                self.live.worker.call(partial(self._apply_settings, values))
        except Exception as error:  # noqa: BLE001 - whoever sets it wants to know
            reason = sentence_and_log('the change', error)
        return SetParametersResult(successful=not reason, reason=reason)

    def _config_with(self, values: Mapping[str, Any]) -> Config:
        """Return the current settings with other values; raises InputError."""
        return configuration.with_values(self.live.config, values, PARAMETER_SOURCE)

    def _apply_settings(self, values: Mapping[str, Any]) -> None:
        """
        Check changed settings and apply them; the worker calls it, so one change after the other.

        See LiveSession.configure for their effects. Where topics change, subscribe to the new ones
        instead. Raises InputError for settings that cannot be used or stored: none is applied.
        """
        config, live = self._config_with(values), self.live
        _require_usable_names(config)
        last_number = live.session.last_number
        for number in {*config.samples.exclude} - {*live.config.samples.exclude}:
            if number > last_number:
                raise InputError(f'there is no sample {number} to exclude: the last stop is '
                                 f'{last_number}; ~/samples lists all')
        if not self.streams.names_other_topics(config):
            live.configure(config)
            return
        if live.session.stops:
            raise InputError('the topics cannot change while there are stops from them: call '
                             '~/clear_samples first, which begins a new session')
        self.streams.stop()
        try:
            live.configure(config, other_topics=True)
        finally:
            self.streams = Streams(self, live, live.add_joints)


def declare_settings(node: Node, folders: OutputFolders) -> tuple[Config, StoredSession | None]:
    """
    Declare all parameters; return the configuration and the session to continue.

    Types are dynamic, so that 3 is accepted for 3.0; config.py checks every value. Raises
    InputError for settings that cannot be used, and for a session that cannot be read.
    """
    # rclpy offers no other access to the values of parameter files and arguments
    overrides = _values_by_key(node._parameter_overrides.values())
    config, stored = settings_and_session(overrides, folders)
    _require_usable_names(config)
    for key in overrides:
        if key.startswith(FILES_ONLY):
            raise InputError(f'{key} is a key of the command line alone: leave it out')
    values, record = configuration.flatten(config), dict(config.record)
    free_text = ParameterDescriptor(description='Kept with the answer.', dynamic_typing=True)
    node.declare_parameters('', [
        *((parameter.key, values[parameter.key], _descriptor(parameter))
          for parameter in configuration.parameters()
          if not parameter.key.startswith(FILES_ONLY)),
        *((f'{RECORD_PREFIX}{name}', record.get(name, ''), free_text)
          for name in dict.fromkeys((*RECORD_NAMES, *record)))], ignore_override=True)
    return config, stored


def _values_by_key(parameters: Iterable[RosParameter]) -> dict[str, Any]:
    """Return values by key, without those that every node has."""
    values = {parameter.name: parameter.value for parameter in parameters
              if not parameter.name.startswith(ROS_OWN_PARAMETERS)}
    # ROS gives an empty list as None, and other lists as arrays
    return {key: value if isinstance(value, str | int | float) else list(value or ())
            for key, value in values.items()}


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return the descriptor shown by `ros2 param describe`."""
    constraints = [f'{text} {" or ".join(map(str, values))}' for text, values in (
        ('number of values:', parameter.length), ('one of', parameter.choices)) if values]
    descriptor = ParameterDescriptor(
        description=parameter.description, dynamic_typing=True,
        read_only=parameter.key in configuration.AT_START_ONLY,
        additional_constraints='; '.join(constraints))
    low, high = parameter.minimum, parameter.maximum
    if low is not None and high is not None:  # rqt_reconfigure makes sliders of them
        if isinstance(parameter.default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return descriptor


def _require_usable_names(config: Config) -> None:
    """Raise InputError for names of targets, methods and folders that would fail later."""
    target_for(config)
    folder_name(config)
