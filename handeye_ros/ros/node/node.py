"""The node `handeye`: topics and services around a LiveSession."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
import os
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from handeye_ros.data import Reject, Sample
from handeye_ros.errors import HandeyeError
from handeye_ros.ros.errors import TopicsError
from handeye_ros.ros.executable import exit_code, InvalidHandle, RCLError, ros
from handeye_ros.ros.node import params
from handeye_ros.ros.node.diagnostics import diagnostics
from handeye_ros.ros.node.intake import Intake, TFMessage, THROTTLE
from handeye_ros.ros.node.live import LiveSession
from handeye_ros.ros.node.outgoing import feature_cloud, LATCHED, markers, transform_stamped
from handeye_ros.ros.node.wording import sample_summary, with_trouble
from rcl_interfaces.msg import SetParametersResult
import rclpy
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

REQUESTS = QoSProfile(depth=1000)  # that wait for a solve; ROS would drop all but ten
UNSENDABLE = (RCLError, InvalidHandle)
THREADS = 4  # the streams, the quick services, a solve, and the rest


class HandeyeNode(Node):
    """Takes samples as the robot moves, and computes, publishes and saves on request."""

    def __init__(self) -> None:
        """Subscribe and serve; raises InputError for what the user configured."""
        super().__init__('handeye')
        config = params.declare(self)
        self._live = LiveSession(config)
        self._told: tuple[str, ...] = ()
        self._advertise()
        self._intake = Intake(self, self._live, self._tell)
        self._serve()
        self.add_on_set_parameters_callback(self._check_change)
        self.add_post_set_parameters_callback(self._apply_change)
        self.get_logger().info(
            f'waiting for profiles on {config.profile_topic}, poses '
            + (f'on {config.pose_topic}' if config.pose_source == 'topic' else 'from /tf'))

    @property
    def is_solving(self) -> bool:
        """Return whether a calibration is being computed."""
        return self._live.is_solving

    def _advertise(self) -> None:
        self._calibration = self.create_publisher(TransformStamped, '~/calibration', LATCHED)
        self._markers = self.create_publisher(MarkerArray, '~/markers', LATCHED)
        self._features = self.create_publisher(PointCloud2, '~/features', 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._tf_static = None
        if TFMessage:
            self._tf_static = self.create_publisher(TFMessage, '/tf_static', LATCHED)
        else:
            self.get_logger().warning('tf2_msgs is not installed: the transform is published on '
                                      '~/calibration only, not on /tf_static')
        # of wall time: the state is told even when a simulated clock stands still
        self.create_timer(1.0, self._diagnose, MutuallyExclusiveCallbackGroup(),
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _serve(self) -> None:
        quick, slow = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        for group, service in ((quick, self.take_sample), (quick, self.remove_last_sample),
                               (quick, self.clear_samples), (slow, self.compute_calibration),
                               (slow, self.save_calibration)):
            self._offer(Trigger, service.__name__, partial(self._answer, service), group)
        self._offer(SetBool, 'auto_sample', self._auto_sample, quick)

    def _offer(self, kind: Any, name: str, callback: Any, group: CallbackGroup) -> None:
        """Create a service; whoever has gone away before the answer must not end the node."""
        service = self.create_service(kind, f'~/{name}', callback, callback_group=group,
                                      qos_profile=REQUESTS)
        send = service.send_response

        def respond(response: Any, header: Any) -> None:
            try:
                send(response, header)
            except UNSENDABLE as error:
                if rclpy.ok():
                    self.get_logger().warning(f'nobody took the answer of ~/{name}: {error}')

        service.send_response = respond

    # what goes out

    def _tell(self, outcomes: Sequence[Sample | Reject]) -> None:
        count = len(self._live.samples) - sum(isinstance(o, Sample) for o in outcomes)
        for outcome in outcomes:
            if isinstance(outcome, Sample):
                count += 1
                self.get_logger().info(f'sample {count}: {sample_summary(outcome)}')
                self._publish_sample(outcome)
            else:
                self.get_logger().warning(f'this stop gave no sample: {outcome.reason}')
        warnings = self._live.warnings
        if warnings and warnings != self._told:
            self._told = warnings
            self.get_logger().warning('; '.join(warnings), throttle_duration_sec=THROTTLE)

    def _publish_sample(self, sample: Sample) -> None:
        self._features.publish(feature_cloud(sample, self._live.config, self._live.frame_id))
        self._publish_markers()

    def _publish_markers(self) -> None:
        live = self._live
        self._markers.publish(markers(live.samples, live.calibration, live.config))

    def _diagnose(self) -> None:
        self._diagnostics.publish(diagnostics(
            self._live, self.get_name(), self.get_clock().now().to_msg(),
            self._intake.obstacle))

    # what is asked; each returns what to say

    def take_sample(self) -> str:
        """Take a sample where the robot stands."""
        sample, text = self._live.take_sample()
        self._publish_sample(sample)
        return text

    def remove_last_sample(self) -> str:
        """Forget the last sample."""
        text = self._live.remove_last_sample()
        self._publish_markers()
        return text

    def clear_samples(self) -> str:
        """Forget all samples and all that was received."""
        text = self._live.clear_samples()
        self._intake.restart()
        self._publish_markers()
        return text

    def compute_calibration(self) -> str:
        """Solve; publish the answer if there is one."""
        calibration, text = self._live.compute()
        transform = transform_stamped(calibration, self.get_clock().now().to_msg())
        self._calibration.publish(transform)
        robot = (self._live.config.robot_base_frame, self._live.config.robot_effector_frame)
        if self._tf_static and calibration.child_frame not in robot:
            self._tf_static.publish(TFMessage(transforms=[transform]))
        self._publish_markers()
        return with_trouble(text, self._live.trouble)

    def save_calibration(self) -> str:
        """Write the last answer."""
        return self._live.save()

    def _answer(self, service: Callable[[], str], _: Trigger.Request,
                response: Trigger.Response) -> Trigger.Response:
        try:
            response.message, response.success = service(), True
            self.get_logger().info(response.message)
        except HandeyeError as error:
            response.message = with_trouble(str(error), self._live.trouble)
            self.get_logger().warning(f'{service.__name__}: {response.message}')
        except UNSENDABLE:
            if rclpy.ok():  # else the node ends, and nobody hears of it any more
                raise
        return response

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
            params.changed(self._live.config, changes, len(self._live.samples))
        except HandeyeError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_change(self, changes: list[Parameter]) -> None:
        self._live.configure(params.changed(self._live.config, changes, 0))


def run() -> None:
    """Run the node until Ctrl-C or SIGTERM."""
    with ros():
        try:
            node = HandeyeNode()
        except RCLError as error:
            raise TopicsError(str(error)) from error
        executor = MultiThreadedExecutor(THREADS)
        executor.add_node(node)
        try:
            executor.spin()
        except KeyboardInterrupt:
            pass
        except RCLError:
            if rclpy.ok():  # else a signal came while it prepared to wait
                raise
        finally:
            executor.shutdown()
            node.destroy_node()
        if node.is_solving:
            # nobody is left to answer; Python would wait for the thread of the solve
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(0)


def main() -> int:
    """Run the executable `calibrate`."""
    return exit_code(run)
