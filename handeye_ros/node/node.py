# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The node `handeye`: topics, services and parameters around a running session."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from functools import partial
from pathlib import Path
import re
from threading import Lock
from typing import Any

from handeye_ros.bags.session import OutputFolders, read_session, SessionFiles
from handeye_ros.errors import HandeyeError
from handeye_ros.node import params
from handeye_ros.node.live import LiveSession
from handeye_ros.node.outputs import Outputs
from handeye_ros.node.pool import Pool
from handeye_ros.node.state import State, state_of, troubles_of, with_trouble
from handeye_ros.node.streams import Streams
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_msgs.msg import Empty
from std_srvs.srv import SetBool, Trigger

CURRENT = 0.2  # s between two messages on ~/current
REQUESTS = QoSProfile(depth=1000)  # may wait for a solve; by default ROS keeps only ten
SLOW = ('compute_calibration', 'verify_result')  # no other service waits for these


class HandeyeNode(Node):
    """Takes samples of stops, and computes, publishes and saves calibrations on request."""

    def __init__(self) -> None:
        """Subscribe and serve; raises InputError for an invalid configuration."""
        super().__init__('handeye')
        self._folders = folders = OutputFolders(self.get_namespace())
        config, stored = params.declare(self, folders)
        self.live = LiveSession(config, folders, SessionFiles(folders.folder, stored), Pool(),
                                lambda: self._outputs.show())
        live, answer, verification = self.live, self.live.answer, self.live.verification
        self._requests: dict[str, Callable[[], Any]] = {work.__name__: work for work in (
            live.take_sample, live.remove_last_sample, live.clear_samples,
            answer.compute_calibration, answer.save_calibration,
            verification.verify_start, verification.verify_result)}
        self._outputs = Outputs(self, self.live)
        self._streams = Streams(self, self.live)
        self._changing = Lock()  # the page sets parameters from its own thread
        self._warned: set[str] = set()  # warnings in the log
        self.add_on_set_parameters_callback(self._check_change)
        self.add_post_set_parameters_callback(self._apply_change)
        if stored:
            self.get_logger().info(self.live.restore(stored.session(config), stored.config))
        elif config.session:
            self.get_logger().warning(f'there is no session in {folders.parent(config)}: a new '
                                      'one begins')
        self._outputs.show()
        self.live.start()
        self._streams.start()
        self._serve()
        self.get_logger().info(f'waiting for profiles on {config.profile_topic}, poses on '
                               f'{self.live.pose_topic}')
        if config.page.port:
            from handeye_ros.page.server import serve  # aiohttp takes long to import
            serve(self)

    def _serve(self) -> None:
        quick = MutuallyExclusiveCallbackGroup()
        for name in self._requests:
            group = MutuallyExclusiveCallbackGroup() if name in SLOW else quick
            self.create_service(Trigger, f'~/{name}', partial(self._answer, name),
                                callback_group=group, qos_profile=REQUESTS)
        self.create_service(SetBool, '~/auto_sample', self._auto_sample, callback_group=quick,
                            qos_profile=REQUESTS)
        self.create_subscription(Empty, '~/take', self._on_take, 10, callback_group=quick)
        # steady time: the state is published even while a simulated clock is paused
        for period, work in ((1.0, self._diagnose), (CURRENT, self._outputs.show_current)):
            self.create_timer(period, work, MutuallyExclusiveCallbackGroup(),
                              clock=Clock(clock_type=ClockType.STEADY_TIME))

    def stop(self) -> None:
        """Publish nothing more: the process ends, and what computes with it."""
        self._outputs.close()

    def topics_of(self, kind: str) -> list[str]:
        """Return the topics with publishers of a message type."""
        return self._streams.topics_of(kind)

    @property
    def state(self) -> State:
        """Return the current state of the session."""
        return state_of(self.live, self._streams.obstacles(), self._streams.trouble())

    def _diagnose(self) -> None:
        """Publish the state, and log the warnings that are new but for their numbers."""
        state = self.state
        self._outputs.diagnose(state)
        warnings = {re.sub(r'[-+.\d]+', '#', sentence): sentence
                    for sentence in (*troubles_of(state), *state['session']['notes'])}
        for kind in warnings.keys() - self._warned:
            self.get_logger().warning(warnings[kind])
        self._warned = set(warnings)

    # services, which the page calls too

    def call_service(self, name: str) -> tuple[bool, str]:
        """Return whether a service succeeds, and its message."""
        try:
            answer = self.live.ask(self._requests[name])
            text, success = answer.result() if isinstance(answer, Future) else answer, True
        except HandeyeError as error:
            text, success = str(error), False
        if name == 'clear_samples' and success:
            self._streams.restart()
        text = with_trouble(self.state, text, success, name)
        if name != 'take_sample':  # which is in the log as an attempt
            log = self.get_logger()
            log.info(text) if success else log.warning(f'{name}: {text}')
        return success, text

    def open_session(self, name: str) -> str:
        """Continue a previous session with the current settings; raises HandeyeError."""
        config = self.live.config
        path = self._folders.folder(config) / Path(name).name
        if path == self.live.files.path:
            return f'{path} is the current session'
        stored = read_session(path)
        files, session = SessionFiles(self._folders.folder, stored), stored.session(config)
        text = self.live.ask(partial(self.live.open, files, session, stored.config))
        self.set_values({'samples.exclude': list(stored.config.samples.exclude)})
        return text

    def set_values(self, values: Mapping[str, Any]) -> str:
        """Set parameters by key; return why one is refused, '' if all are set."""
        results = self.set_parameters([
            # ROS gives an empty list no type
            Parameter(key, Parameter.Type.INTEGER_ARRAY, value) if value == [] else
            Parameter(key, value=value) for key, value in values.items()])
        return '; '.join(result.reason for result in results if not result.successful)

    def _answer(self, name: str, _: Trigger.Request, response: Trigger.Response
                ) -> Trigger.Response:
        response.success, response.message = self.call_service(name)
        return response

    def _on_take(self, _: Empty) -> None:
        self.call_service('take_sample')

    def _auto_sample(self, request: SetBool.Request, response: SetBool.Response
                     ) -> SetBool.Response:
        refusal = self.set_values({'sampling.mode': 'still' if request.data else 'manual'})
        response.success, response.message = not refusal, refusal or (
            'a sample is taken at every stop of the robot' if request.data else
            'samples are taken by ~/take_sample only')
        return response

    # parameters

    def _check_change(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            self._streams.changes(params.changed(self.live.config, changes))
        except HandeyeError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_change(self, changes: list[Parameter]) -> None:
        with self._changing:
            config = params.changed(self.live.config, changes)
            other_topics = self._streams.changes(config)
            self.live.ask(partial(self.live.configure, config))
        if other_topics:
            self.live.ask(self.live.clear_samples)
            self._streams.listen()
