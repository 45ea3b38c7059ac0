"""The node `handeye`: topics and services around a session that goes on."""
from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any

from handeye_ros.diagnosis.summaries import in_the_way, sample_summary, with_trouble
from handeye_ros.errors import HandeyeError
from handeye_ros.ros.executable import offer, UNSENDABLE
from handeye_ros.ros.node import params
from handeye_ros.ros.node.diagnostics import RepeatedWarnings, same_name, topics_of
from handeye_ros.ros.node.intake import Intake
from handeye_ros.ros.node.kinematics import compute
from handeye_ros.ros.node.live import LiveSession
from handeye_ros.ros.node.publishers import Publishers
from handeye_ros.ros.node.status import state_of
from handeye_ros.ros.node.worker import WorkerProcess
from handeye_ros.ros.sessions.reading import is_session, read_session
from handeye_ros.ros.sessions.store import Place
from handeye_ros.ros.sessions.writing import SessionStore
from handeye_ros.sampling.state import State
from handeye_ros.sampling.stops import Outcome
from rcl_interfaces.msg import SetParametersResult
import rclpy
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Empty
from std_srvs.srv import SetBool, Trigger

CURRENT = 0.2  # s between two pictures of what is seen now
LOWER = 5  # priority of what takes long


class HandeyeNode(Node):
    """Takes samples as the robot moves, and computes, publishes and saves on request."""

    def __init__(self) -> None:
        """Subscribe and serve; raises InputError for what the user configured."""
        super().__init__('handeye')
        config, stored = params.declare(self)
        self._place = place = Place(self.get_namespace())
        self.live = LiveSession(config, place, SessionStore(place.folder, stored),
                                WorkerProcess(LOWER), WorkerProcess())
        self._outputs = Publishers(self, self.live)
        self._intake = Intake(self, self.live)
        self._warnings = RepeatedWarnings(self.get_logger().warning)
        self._changing = Lock()  # the page sets parameters, too
        self._serve()
        self.add_on_set_parameters_callback(self._check_change)
        self.add_post_set_parameters_callback(self._apply_change)
        self.live.on_outcome = partial(self._quietly, self._on_outcome)
        self.live.on_change = partial(self._quietly, self._outputs.show)
        self.live.on_failure = self.get_logger().error
        if stored:
            self.get_logger().info(self.live.restore(stored.session(config), stored.config))
        elif config.session:
            self.get_logger().warning(f'there is no session in {place.parent(config)}: a new one '
                                      'begins')
        self.live.start()
        self._intake.start()
        self._outputs.show()
        self.get_logger().info(
            f'waiting for profiles on {config.profile_topic}, poses '
            + (f'on {config.pose_topic}' if config.pose_source == 'topic' else 'from /tf'))
        self._page = None
        if config.page.port:
            from handeye_ros.ros.page.server import serve  # aiohttp takes long to import
            self._page = serve(self)

    def stop(self) -> None:
        """End what is being computed, and tell nothing more of it."""
        self._outputs.close()
        self.live.stop()

    def destroy_node(self) -> None:
        """End the page and what is being computed, too."""
        self.stop()
        if self._page:
            self._page.stop()
        super().destroy_node()

    @property
    def is_busy(self) -> bool:
        """Return whether a thread is at work that Python would wait for."""
        return bool(self.live.progress.text)

    @property
    def token_file(self) -> Path:
        """Return the file that keeps the token of the page."""
        return self._place.parent(self.live.config) / '.page_token'

    @property
    def sessions(self) -> list[str]:
        """Return the names of the sessions that can be opened, the newest first."""
        folder = self._place.folder(self.live.config)
        folders = folder.iterdir() if folder.is_dir() else ()
        return sorted((path.name for path in folders if is_session(path)), reverse=True)

    def topics_of(self, kind: str) -> list[str]:
        """Return the topics on which others publish messages of a type."""
        return topics_of(self, kind)

    @property
    def state(self) -> State:
        """Return all that is told of the session, as of now."""
        return state_of(self.live, self._intake.obstacle, same_name(self))

    def _serve(self) -> None:
        samples = MutuallyExclusiveCallbackGroup()
        for services in ((self.compute_calibration,), (self.save_calibration,),
                         (self.compute_kinematics,),
                         (self.verify_start, self.verify_result)):
            self._offer_all(services, MutuallyExclusiveCallbackGroup())
        self._offer_all((self.take_sample, self.remove_last_sample, self.clear_samples), samples)
        offer(self, SetBool, 'auto_sample', self._auto_sample, samples)
        self.create_subscription(Empty, '~/take', self._on_take, 10, callback_group=samples)
        # of wall time: the state is told even when a simulated clock stands still
        for period, tell in ((1.0, self._diagnose), (CURRENT, self._outputs.show_current)):
            self.create_timer(period, partial(self._quietly, tell),
                              MutuallyExclusiveCallbackGroup(),
                              clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _offer_all(self, services: Iterable[Callable[[], str]], group: CallbackGroup) -> None:
        """Create services of which one waits for the other."""
        for service in services:
            offer(self, Trigger, service.__name__, partial(self._answer, service), group)

    # what is reported

    def _quietly(self, tell: Callable[..., object], *args: Any) -> None:
        """Tell something, unless the node ends, and nobody hears of it any more."""
        try:
            tell(*args)
        except UNSENDABLE:
            if rclpy.ok():
                raise

    def _on_outcome(self, outcome: Outcome) -> None:
        attempt = self.live.samples.attempt
        text = attempt.text if attempt else sample_summary(outcome.result)
        if outcome.sample:
            self.get_logger().info(text)
            self._outputs.show_features(outcome)
        else:
            self.get_logger().warning(text)

    def _diagnose(self) -> None:
        state = self.state
        self._outputs.diagnose(state)
        self._warnings.update((*state.troubles, *state.session.notes))

    # what is asked; each returns what to say

    def take_sample(self) -> str:
        """Take a sample where the robot stands."""
        return self.live.samples.take()

    def remove_last_sample(self) -> str:
        """Forget the last sample."""
        return self.live.samples.remove_last()

    def clear_samples(self) -> str:
        """Forget all samples and all that was received."""
        text = self.live.clear_samples()
        self._intake.restart()
        return text

    def compute_calibration(self) -> str:
        """Solve, and publish the answer if there is one."""
        return self.live.answer.compute()[1]

    def save_calibration(self) -> str:
        """Write the last answer."""
        return self.live.answer.save()

    def open_session(self, name: str) -> str:
        """Go on with a former session of this name, with the settings of now; HandeyeError."""
        config = self.live.config
        path = self._place.folder(config) / Path(name).name
        if path == Path(self.live.samples.store.path):
            return f'{path} is the session of now'
        stored = read_session(path)
        store, session = SessionStore(self._place.folder, stored), stored.session(config)
        text = self.live.replace_session(store, session, stored.config)
        self.set_parameters([Parameter('samples.exclude', Parameter.Type.INTEGER_ARRAY,
                                       list(stored.config.samples.exclude))])
        return text

    def compute_kinematics(self) -> str:
        """Find the errors of the arm, and write the corrected one."""
        return compute(self._intake.kinematics)

    def verify_start(self) -> str:
        """Let the stops from now on verify the calibration."""
        return self.live.verification.begin()

    def verify_result(self) -> str:
        """Tell and write what they say of it."""
        return self.live.verification.result()

    def ask(self, service: Callable[[], str]) -> tuple[bool, str]:
        """Return whether one of these succeeds, and the one sentence that tells so."""
        try:
            text, success = service(), True
        except HandeyeError as error:
            text, success = str(error), False
        text = with_trouble(text, in_the_way(self.state, success, service.__name__))
        log = self.get_logger()
        if not success:
            log.warning(f'{service.__name__}: {text}')
        elif service != self.take_sample:  # which is in the log as an outcome
            log.info(text)
        return success, text

    def _answer(self, service: Callable[[], str], _: Trigger.Request,
                response: Trigger.Response) -> Trigger.Response:
        try:
            response.success, response.message = self.ask(service)
        except UNSENDABLE:
            if rclpy.ok():  # else the node ends, and nobody hears of it any more
                raise
        return response

    def _on_take(self, _: Empty) -> None:
        self._quietly(self.ask, self.take_sample)

    def _auto_sample(self, request: SetBool.Request, response: SetBool.Response
                     ) -> SetBool.Response:
        result = self.set_parameters([Parameter(
            'sampling.mode', value='still' if request.data else 'manual')])[0]
        response.success, response.message = result.successful, result.reason
        if result.successful:
            response.message = ('a sample is taken at every stop of the robot' if request.data
                                else 'samples are taken by ~/take_sample only')
        return response

    # what is set

    def _check_change(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            self._intake.changes(params.changed(self.live.config, changes))
        except HandeyeError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_change(self, changes: list[Parameter]) -> None:
        with self._changing:
            config = params.changed(self.live.config, changes)
            others = self._intake.changes(config)
            self.live.configure(config)
        if others:
            self.live.clear_samples()
            self._intake.listen()
