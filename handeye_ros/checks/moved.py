"""Whether target or sensor was moved in the middle of a recording: each part fits by itself."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.checks.errors import MovedError
from handeye_ros.checks.motion import mount_frame, target_frame
from handeye_ros.data import Array
from handeye_ros.estimation.consensus import Consensus, fast_consensus
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.quantiles import chi2_isf, f_isf
import numpy as np

MOST_PLACES = 15  # at which a recording is parted to see
BELIEVABLE = 4.0  # variance factor of both parts
CHANCE = 1e-5  # of naming a move where there is none
LARGEST_UNEXPLAINED_SHARE = 0.25  # of a part


@dataclass(frozen=True, eq=False)
class Move:
    """
    What happened before a station.

    station: the first one after it; sensor: (4, 4) the later transform of the sensor in the
    earlier sensor's frame, None where the sensor stayed and so the target must have moved.
    """

    station: int
    sensor: Array | None


def find_move(problem: Problem, agreed: Consensus) -> Move | None:
    """
    Return the move that explains why the stations, in order of time, contradict each other.

    None where none does, by an F-test.
    """
    n, fewest = len(problem.poses), problem.method.minimum
    places = np.unique(np.linspace(fewest, n - fewest, MOST_PLACES).round().astype(int))
    found = [(both, int(place)) for place in places if n >= 2 * fewest
             and (both := _parts(problem, int(place)))]
    if not found:
        return None
    both, place = min(found, key=lambda pair: (_dropped(pair[0]), _variance(pair[0])))
    freedom = sum(part.solution.degrees_of_freedom for part in both)
    gain = _without_drops(problem, agreed) / max(_variance(both), 1.0)
    if gain < f_isf(CHANCE, freedom, freedom):
        return None
    return Move(place, _sensor_move(*both))


def _parts(problem: Problem, place: int) -> tuple[Consensus, Consensus] | None:
    """Return what the stations before and from a place on agree on, None unless they do."""
    every = np.arange(len(problem.poses))
    parts = []
    for stations in (every[:place], every[place:]):
        part = fast_consensus(problem.subset(stations))
        if part is None:
            return None
        solution = part.solution
        if (part.unused_share > LARGEST_UNEXPLAINED_SHARE
                or solution.variance_factor > BELIEVABLE or solution.degrees_of_freedom < 1):
            return None
        parts.append(part)
    return parts[0], parts[1]


def _dropped(both: tuple[Consensus, Consensus]) -> int:
    return sum(len(part.dropped) for part in both)


def _variance(both: tuple[Consensus, Consensus]) -> float:
    """Return the variance factor of both parts together."""
    squares = sum(float(part.solution.white @ part.solution.white) for part in both)
    return squares / sum(part.solution.degrees_of_freedom for part in both)


def _without_drops(problem: Problem, agreed: Consensus) -> float:
    """Return the variance factor of all stations, those dropped included."""
    solution = agreed.solution
    squares = float(solution.white @ solution.white) + sum(agreed.dropped.values())
    return squares / (solution.degrees_of_freedom + len(agreed.dropped))


def _sensor_move(before: Consensus, after: Consensus) -> Array | None:
    """Return by how much the sensor moved in its own frame, None if it may have stayed."""
    first, second = before.solution, after.solution
    delta = se3.difference(second.estimate.X, first.estimate.X)
    covariance = (first.reported[:6, :6] * max(first.variance_factor, 1.0)
                  + second.reported[:6, :6] * max(second.variance_factor, 1.0))
    if delta @ np.linalg.solve(covariance, delta) < chi2_isf(CHANCE, 6):
        return None
    return se3.inverse(first.estimate.X) @ second.estimate.X


def require_unmoved(problem: Problem, agreed: Consensus) -> None:
    """Raise MovedError when two parts of the recording fit, each by itself."""
    move, total = find_move(problem, agreed), len(problem.poses)
    if move is None:
        return
    if move.sensor is None:
        raise MovedError.target(move.station, total, target_frame(problem.config))
    distance, turn = np.linalg.norm(move.sensor[:3, 3]), se3.angle(move.sensor[:3, :3])
    raise MovedError.sensor(move.station, total, float(distance), float(turn),
                            mount_frame(problem.config))
