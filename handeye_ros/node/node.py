"""The node `handeye`: topics, services and parameters around a running session."""
from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any

from handeye_ros.bags.session_reading import read_session
from handeye_ros.bags.session_store import OutputFolders
from handeye_ros.bags.session_writing import SessionStore
from handeye_ros.checks.review import sample_summary
from handeye_ros.errors import HandeyeError, InputError
from handeye_ros.node import params
from handeye_ros.node.diagnostics import RepeatedWarnings, same_name, topics_of
from handeye_ros.node.executable import offer, UNSENDABLE
from handeye_ros.node.intake import Intake
from handeye_ros.node.kinematics import NO_URDF
from handeye_ros.node.live import LiveSession
from handeye_ros.node.publishers import Publishers
from handeye_ros.node.state import State
from handeye_ros.node.status import state_of
from handeye_ros.node.worker import WorkerProcess
from handeye_ros.sampling.stops import Outcome
from rcl_interfaces.msg import SetParametersResult
import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Empty
from std_srvs.srv import SetBool, Trigger

CURRENT = 0.2  # s between two messages on ~/current
NICER = 5  # nice value of the process that solves: the streams come first
# Services of type Trigger; those of a group wait for each other.
GROUPS = (('compute_calibration',), ('save_calibration',), ('compute_kinematics',),
          ('verify_start', 'verify_result'),
          ('take_sample', 'remove_last_sample', 'clear_samples'))


class HandeyeNode(Node):
    """Takes samples of stops, and computes, publishes and saves calibrations on request."""

    def __init__(self) -> None:
        """Subscribe and serve; raises InputError for an invalid configuration."""
        super().__init__('handeye')
        self._folders = folders = OutputFolders(self.get_namespace())
        config, stored = params.declare(self, folders)
        self.live = LiveSession(config, folders, SessionStore(folders.folder, stored),
                                WorkerProcess(NICER), WorkerProcess())
        self._outputs = Publishers(self, self.live)
        self._intake = Intake(self, self.live)
        self._warnings = RepeatedWarnings(self._warn)
        self._changing = Lock()  # the page sets parameters from its own thread
        self._serve()
        self.add_on_set_parameters_callback(self._check_change)
        self.add_post_set_parameters_callback(self._apply_change)
        self.live.on_outcome = partial(self._quietly, self._on_outcome)
        self.live.on_change = partial(self._quietly, self._outputs.show)
        self.live.on_failure = self.get_logger().error
        if stored:
            self.get_logger().info(self.live.restore(stored.session(config), stored.config))
        elif config.session:
            self.get_logger().warning(f'there is no session in {folders.parent(config)}: a new '
                                      'one begins')
        self.live.start()
        self._intake.start()
        self._outputs.show()
        self.get_logger().info(
            f'waiting for profiles on {config.profile_topic}, poses '
            + (f'on {config.pose_topic}' if config.pose_source == 'topic' else 'from /tf'))
        self._page = None
        if config.page.port:
            from handeye_ros.page.server import serve  # aiohttp takes long to import
            self._page = serve(self)

    def stop(self) -> None:
        """Stop computing and publishing."""
        self._outputs.close()
        self.live.stop()

    def destroy_node(self) -> None:
        """Stop the page and all computations, then destroy the node."""
        self.stop()
        if self._page:
            self._page.stop()
        super().destroy_node()

    def topics_of(self, kind: str) -> list[str]:
        """Return the topics with publishers of a message type."""
        return topics_of(self, kind)

    @property
    def state(self) -> State:
        """Return the current state of the session."""
        return state_of(self.live, self._intake.obstacle, same_name(self))

    def _serve(self) -> None:
        live = self.live
        self._triggers: dict[str, Callable[[], str]] = {
            'take_sample': live.samples.take,
            'remove_last_sample': live.samples.remove_last,
            'clear_samples': self._clear_samples,
            'compute_calibration': lambda: live.answer.compute()[1],
            'save_calibration': live.answer.save,
            'compute_kinematics': self._compute_kinematics,
            'verify_start': live.verification.begin,
            'verify_result': live.verification.result}
        for names in GROUPS:
            group = MutuallyExclusiveCallbackGroup()
            for name in names:
                offer(self, Trigger, name, partial(self._answer, name), group)
        offer(self, SetBool, 'auto_sample', self._auto_sample, group)
        self.create_subscription(Empty, '~/take', self._on_take, 10, callback_group=group)
        # steady time: the state is published even while a simulated clock is paused
        for period, work in ((1.0, self._diagnose), (CURRENT, self._outputs.show_current)):
            self.create_timer(period, partial(self._quietly, work),
                              MutuallyExclusiveCallbackGroup(),
                              clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _quietly(self, work: Callable[..., object], *args: Any) -> None:
        """Run work that publishes; its failure while the node ends is ignored."""
        try:
            work(*args)
        except UNSENDABLE:
            if rclpy.ok():
                raise

    def _on_outcome(self, outcome: Outcome) -> None:
        attempt = self.live.samples.attempt
        text = attempt.text if attempt else sample_summary(outcome.result)
        if outcome.sample:
            self._inform(text)
            self._outputs.show_features(outcome)
        else:
            self._warn(text)

    def _diagnose(self) -> None:
        state = self.state
        self._outputs.diagnose(state)
        self._warnings.update((*state.troubles, *state.session.notes))

    def _clear_samples(self) -> str:
        text = self.live.clear_samples()
        self._intake.restart()
        return text

    def _compute_kinematics(self) -> str:
        if self._intake.kinematics is None:
            raise InputError(NO_URDF)
        return self._intake.kinematics.compute()

    def open_session(self, name: str) -> str:
        """Continue a previous session with the current settings; raises HandeyeError."""
        config = self.live.config
        path = self._folders.folder(config) / Path(name).name
        if path == Path(self.live.samples.store.path):
            return f'{path} is the current session'
        stored = read_session(path)
        store, session = SessionStore(self._folders.folder, stored), stored.session(config)
        text = self.live.replace_session(store, session, stored.config)
        self.set_parameters([Parameter('samples.exclude', Parameter.Type.INTEGER_ARRAY,
                                       list(stored.config.samples.exclude))])
        return text

    def call_service(self, name: str) -> tuple[bool, str]:
        """Return whether a service succeeds, and its message."""
        try:
            text, success = self._triggers[name](), True
        except HandeyeError as error:
            text, success = str(error), False
        text = self.state.with_trouble(text, success, name)
        if not success:
            self._warn(f'{name}: {text}')
        elif name != 'take_sample':  # its outcome is in the log already
            self._inform(text)
        return success, text

    def _inform(self, text: str) -> None:
        if rclpy.ok():  # once a signal has shut ROS down, rcl would print an error of its own
            self.get_logger().info(text)

    def _warn(self, text: str) -> None:
        if rclpy.ok():
            self.get_logger().warning(text)

    def _answer(self, name: str, _: Trigger.Request, response: Trigger.Response
                ) -> Trigger.Response:
        try:
            response.success, response.message = self.call_service(name)
        except UNSENDABLE:
            if rclpy.ok():  # else the node ends
                raise
        return response

    def _on_take(self, _: Empty) -> None:
        self._quietly(self.call_service, 'take_sample')

    def _auto_sample(self, request: SetBool.Request, response: SetBool.Response
                     ) -> SetBool.Response:
        result = self.set_parameters([Parameter(
            'sampling.mode', value='still' if request.data else 'manual')])[0]
        response.success, response.message = result.successful, result.reason
        if result.successful:
            response.message = ('a sample is taken at every stop of the robot' if request.data
                                else 'samples are taken by ~/take_sample only')
        return response

    def _check_change(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            self._intake.changes(params.changed(self.live.config, changes))
        except HandeyeError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_change(self, changes: list[Parameter]) -> None:
        with self._changing:
            config = params.changed(self.live.config, changes)
            other_topics = self._intake.changes(config)
            self.live.configure(config)
        if other_topics:
            self.live.clear_samples()
            self._intake.listen()
