"""Kinematic calibration by a running node, from its samples and joint values."""
from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path
from threading import Lock

from handeye_ros.bags.bag import joints_and_pose
from handeye_ros.bags.bag_write import joints_cdr
from handeye_ros.bags.session_reading import joints_of
from handeye_ros.checks.settings import require_same_clock
from handeye_ros.config import Config
from handeye_ros.data import Array, TimedPose
from handeye_ros.node.live import LiveSession
from handeye_ros.robot.causes import ContradictionError, TooFewConfigurationsError
from handeye_ros.robot.model import Arm
from handeye_ros.robot.samples import solve_sources, Source
from handeye_ros.robot.urdf import read_chain
import numpy as np
from numpy.typing import NDArray

FOLDER = 'kinematics'  # below that of the session's results
MOST = 1_000_000  # messages with joint values that are kept: hours of a driver at 100 Hz
COMPUTED = 'the kinematics are being computed'
NO_URDF = ('~/compute_kinematics needs the URDF of the robot: start the node with the parameter '
           'robot_description set to its file, and joint_topic')


class LiveKinematics:
    """Received joint values, the flange poses of the nominal arm, and its estimated errors."""

    def __init__(self, live: LiveSession, config: Config) -> None:
        """Read the URDF that robot_description names; raises InputError."""
        path = Path(config.robot_description)
        self._live, self._lock = live, Lock()
        self._urdf, chain = read_chain(path, config.robot_base_frame, config.robot_effector_frame)
        self._arm = Arm(chain)
        self._stamps, self._joints = array('q'), array('d')
        if live.samples.store.path:  # an earlier session is continued
            stamps, q = joints_of(Path(live.samples.store.path), config, self._arm.chain)
            self._stamps.extend(stamps.tolist())
            self._joints.extend(q.ravel().tolist())

    def pose(self, data: bytes) -> TimedPose:
        """Return the flange pose of a serialised JointState, and store it."""
        q, pose = joints_and_pose(self._arm, data)
        with self._lock:
            self._stamps.append(pose.stamp)
            self._joints.extend(q.tolist())
            if len(self._stamps) > MOST:
                del self._stamps[:MOST // 2], self._joints[:MOST // 2 * len(q)]
        return pose

    def _received(self) -> tuple[NDArray[np.int64], Array]:
        """Return stamps (n,) and joint values (n, joints)."""
        with self._lock:
            stamps = np.array(self._stamps, dtype=np.int64)
            return stamps, np.array(self._joints).reshape(len(stamps), len(self._arm.chain.joints))

    def between(self, first: int, last: int) -> Iterator[tuple[int, bytes]]:
        """Yield stamps and serialised messages between two stamps, for storage."""
        stamps, q = self._received()
        rows = np.flatnonzero((stamps >= first) & (stamps <= last))
        readings = self._arm.chain.measured_values(q[rows])
        for stamp, *values in zip(stamps[rows], *readings.values(), strict=True):
            yield int(stamp), joints_cdr(int(stamp), np.array(values), list(readings))

    def compute(self) -> str:
        """Estimate and write the corrected arm; return the message. Raises HandeyeError."""
        live, chain = self._live, self._arm.chain
        session, config = live.samples.session_after(live.samples.evaluate_rest)
        source = Source.of(session.samples, session.rejects, session.frame_id, config, chain,
                           *self._received(), inputs=[{'topic': config.profile_topic},
                                                      {'topic': config.joint_topic}])
        with live.progress.doing(COMPUTED):
            try:
                answer = live.solver.run(solve_sources, [source], chain, urgent=True)
            except (ContradictionError, TooFewConfigurationsError):
                require_same_clock(session, source.config)
                raise
        folder = live.folders.folder(config) / FOLDER
        sentences = (answer.sentence, answer.save(self._urdf, folder, config.save.formats))
        return '; '.join([*sentences, *answer.warnings])
