"""How far the samples are spread, in words for who moves the robot."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.solution import Solution
from handeye_ros.guidance.following import anchor_of
from handeye_ros.guidance.limits import Limits, twist_of
from handeye_ros.guidance.moves import noun
from handeye_ros.guidance.view import View
import numpy as np

WANTED_TILT = 0.6  # of the largest tilt, to either side
WANTED_TURN = 0.52  # rad to either side
WANTED_PLACES = 0.5  # of the view
FILLING = 0.6  # of the view's width: what fills it has no place along the line
WANTED_PER_EDGE = 3


@dataclass(frozen=True)
class Spread:
    """Of one way to differ, how much there is and how much is wanted, and both in words."""

    share: float
    text: str


def missing(solution: Solution, view: View, limits: Limits) -> list[str]:
    """Return what the samples of a solution lack, the worst first, each in words."""
    problem = solution.problem
    found = [*_rotations(problem.poses, solution.estimate.X, limits), *_coverage(problem, view),
             *_edges(problem)]
    return [s.text for s in sorted(found, key=lambda s: s.share) if s.share < 1.0]


def _rotations(poses: Array, X: Array, limits: Limits) -> list[Spread]:
    first, R = limits.first[:3, :3] @ X[:3, :3], poses[:, :3, :3] @ X[:3, :3]
    twist = twist_of(first, R)
    about_z = np.column_stack([np.zeros((len(R), 2)), twist])
    swing = se3.log_rotation(np.swapaxes(first @ se3.exp_rotation(about_z), 1, 2) @ R)
    tilt, turn = WANTED_TILT * limits.tilt, min(WANTED_TURN, WANTED_TILT * limits.turn)
    return [_turned('tilt about the laser line', swing[:, 0], tilt),
            _turned('tilt about the normal of the light plane', swing[:, 1], tilt),
            _turned('turn about the viewing direction', twist, turn)]


def _turned(what: str, angles: Array, wanted: float) -> Spread:
    """Return the spread of angles (n,) to either side."""
    half = float(np.ptp(angles)) / 2
    return Spread(half / wanted if wanted else 1.0,
                  f'{what}: {np.degrees(half):.0f} degrees to either side so far, '
                  f'{np.degrees(wanted):.0f} wanted')


def _coverage(problem: Problem, view: View) -> list[Spread]:
    """Return the spread of what was seen over the view, along the line and in range."""
    obs, n = problem.observations, len(problem.poses)
    anchors = np.array([anchor_of(problem, i) for i in range(n)])
    lengths = [np.ptp(obs.points[obs.station == i], axis=0)[0] for i in range(n)]
    fills = np.median(lengths) > FILLING * view.size[0]
    found = []
    for axis, what in ((0, 'along the laser line'), (1, 'in range')):
        so_far, wanted = np.ptp(anchors[:, axis]), WANTED_PLACES * view.size[axis]
        if wanted > 0 and not (axis == 0 and fills):
            found.append(Spread(float(so_far / wanted), (
                f'places of the {noun(problem.method)} {what}: over {so_far * 1e3:.0f} mm so '
                f'far, {wanted * 1e3:.0f} mm wanted')))
    return found


def _edges(problem: Problem) -> list[Spread]:
    """Return for each edge that was seen how many samples saw it, if there are several."""
    obs, method = problem.observations, problem.method
    if len(method.essential) < 2:
        return []
    counts = {method.kinds[k]: len(np.unique(obs.station[obs.kind == k]))
              for k in np.unique(obs.kind) if method.kinds[k] in method.essential}
    return [Spread(count / WANTED_PER_EDGE, f'edge {name}: {count} samples so far, '
                   f'{WANTED_PER_EDGE} wanted') for name, count in counts.items()]
