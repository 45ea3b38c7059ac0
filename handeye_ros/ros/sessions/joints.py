"""The joint values that a session holds beside its samples."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.kinematics.chain import Chain
from handeye_ros.kinematics.model import Arm
from handeye_ros.kinematics.samples import configured, Source
from handeye_ros.ros.bags.bag import read_poses
from handeye_ros.ros.bags.poses import PoseTable
from handeye_ros.ros.sessions.reading import Stored
import numpy as np
from numpy.typing import NDArray


def joints_of(path: Path, config: Config, chain: Chain) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (n,) and joint values (n, joints); raises InputError where there are none."""
    poses, _ = read_poses(path, replace(config, kinematics=''), Arm(chain))
    assert isinstance(poses, PoseTable) and poses.joints is not None
    return np.array([pose.stamp for pose in poses], dtype=np.int64), poses.joints


def source_of_session(stored: Stored, config: Config, chain: Chain) -> Source:
    """Return the samples of a session with their joint values; raises InputError."""
    session = stored.session(config)
    return Source(session.samples, session.rejects, session.frame_id, configured(config, chain),
                  *joints_of(stored.path, config, chain), session=session,
                  inputs=[{'path': str(stored.path)}], warnings=session.warnings)
