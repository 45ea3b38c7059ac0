"""
The hand-eye transform from points with nothing given: where an estimate starts.

And what makes them fit after all where they contradict the joint values: usual mistakes.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
import math

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import DataError
from handeye_ros.estimation.solver import graduated, reweighted, Rows, System
from handeye_ros.kinematics.chain import Chain, REVOLUTE
from handeye_ros.kinematics.errors import TooFewConfigurationsError
from handeye_ros.kinematics.estimate import adjusted, Fit, fitted, LEAST_NOISE, MINIMUM, Weights
from handeye_ros.kinematics.model import Arm
from handeye_ros.kinematics.points import Points, State
import numpy as np
from scipy.spatial.transform import Rotation

SWEPT = 4000  # random rotations that are compared
APART = 0.2  # least angle between two starts (rad)
STARTS = 8  # how many are refined
ROUGH = 1e-3  # residuals (m) of a start, whose robot is only inaccurate
SEED = 0  # of the search: the same points give the same answer
FEW = 2  # starts: a cause is seen by any of them
BETTER = 0.2  # a change that lowers the residual to less than this share is the cause
OTHER_SIDE = {'eye_in_hand': 'eye_on_base', 'eye_on_base': 'eye_in_hand'}


def first_fit(data: Points, arm: Arm, most: int = STARTS) -> Fit:
    """
    Return the hand-eye transform alone, with the arm as it is, however far it is off.

    most: starts that are refined. Raises TooFewConfigurationsError.
    """
    if len(data) < MINIMUM:
        raise TooFewConfigurationsError(len(data), MINIMUM)
    rough, nothing = Weights(np.full(3, ROUGH), np.zeros(0)), np.zeros((len(data), 0))

    def refit(state: State, weights: Array) -> State:
        return reweighted(System(rows, data.moved, data.block), state, weights)

    def rows(at: State) -> Rows:
        r, J = data.linearised(at, nothing)
        return Rows(r / ROUGH, lambda: J / ROUGH)

    def squares(at: State) -> Array:
        return np.asarray((rows(at).residuals.reshape(-1, 3) ** 2).mean(axis=1))
    ends = [graduated(start, squares, refit)
            for start in starts(data, arm, most, np.random.default_rng(SEED))]
    state = min(ends, key=lambda end: float(np.median(squares(end))))
    final = squares(state)
    used = final <= 25.0 * max(float(np.median(final)), (LEAST_NOISE / ROUGH) ** 2)
    if used.sum() < MINIMUM:
        raise TooFewConfigurationsError(int(used.sum()), MINIMUM)
    return adjusted(fitted(data, state, rough, used, nothing))


def starts(data: Points, arm: Arm, most: int, rng: np.random.Generator) -> list[State]:
    """
    Return up to `most` estimates to start from, the best first, without any error of the arm.

    For a given rotation of the sensor all else is linear, so the squared residual is a quadratic
    function of the nine numbers of a rotation. It is evaluated at many random rotations.
    """
    T, n, t = arm.forward(data.q), len(data), len(data.names)
    R, a = T[:, :3, :3], T[:, :3, 3]
    unit = np.broadcast_to(np.eye(3), R.shape)
    to_mount, to_target = (R, unit) if data.on_flange else (unit, R)
    A = np.zeros((n, 3, 3 + 3 * t))
    A[:, :, :3] = to_mount
    for k in range(3):
        A[np.arange(n), :, 3 + 3 * data.target + k] = -to_target[:, :, k]
    b = a if data.on_flange else -a
    M = np.einsum('nij,nk->nijk', to_mount, data.points).reshape(3 * n, 9)
    both = np.column_stack([M, b.ravel()])
    flat = A.reshape(3 * n, -1)
    inverse = np.linalg.pinv(flat, rcond=1e-9)
    left = both - flat @ (inverse @ both)
    gram = left.T @ left
    rotations = Rotation.random(SWEPT, random_state=rng).as_matrix()
    v = np.column_stack([rotations.reshape(-1, 9), np.ones(SWEPT)])
    cost = np.einsum('ki,ij,kj->k', v, gram, v)
    found: list[State] = []
    for i in np.argsort(cost, kind='stable'):
        turned = rotations[i]
        if all(se3.angle(turned @ s.X[:3, :3].T) > APART for s in found):
            linear = -inverse @ (both @ v[i])
            found.append(State(se3.transform(turned, linear[:3]), linear[3:].reshape(t, 3), arm,
                               np.zeros((0, 3))))
        if len(found) == most:
            break
    return found


@dataclass(frozen=True, eq=False)
class Change:
    """
    What may be wrong, in words, and how it is put right.

    joints: (n, n) what the joint values are multiplied by; other_side: of calibration_type; unit:
    a factor on the points of the sensor.
    """

    words: str
    joints: Array
    other_side: bool = False
    unit: float = 1.0


def cause_of(chain: Chain, q: Array, on_flange: bool, refit: Callable[[Change], float]) -> str:
    """
    Return what makes joint values and measurements agree after all, empty where nothing does.

    q: (n, joints); refit: gives the residual with a change.
    """
    as_stated, *changes = _changes(chain, on_flange, float(np.median(np.abs(q).max(axis=0))))
    best, found = BETTER * refit(as_stated), ''
    for change in changes:
        try:
            rms = refit(change)
        except (DataError, np.linalg.LinAlgError):
            continue
        if rms < best:
            best, found = rms, change.words
    still = [joint.name for joint, moves in zip(chain.joints, np.ptp(q, axis=0) > 0, strict=True)
             if not moves]
    return found or (f'{still[0]} has the same value throughout: check where its values come from'
                     if still else '')


def cause_of_points(data: Points, chain: Chain) -> str:
    """Return what makes joint values and measured points agree, empty where nothing does."""
    def refit(change: Change) -> float:
        changed = replace(data, q=data.q @ change.joints.T, points=data.points * change.unit,
                          on_flange=data.on_flange != change.other_side)
        return first_fit(changed, Arm(chain), FEW).noise_rms
    return cause_of(chain, data.q, data.on_flange, refit)


def _changes(chain: Chain, on_flange: bool, largest: float) -> Iterator[Change]:
    """Yield what may be wrong; largest: the values of half of the joints. The first is none."""
    same = np.eye(len(chain.joints))
    turning = np.array([joint.kind == REVOLUTE for joint in chain.joints])
    yield Change('', same)
    for factor, words, possible in (
            (math.radians(1), 'degrees that are stated as radians', largest > 2 * math.pi),
            (math.degrees(1), 'radians that are stated as degrees', largest < math.radians(10))):
        if possible:
            yield Change(f'the joint values seem to be {words}', np.diag(
                np.where(turning, factor, 1.0)))
    for joint, one in zip(chain.joints, same, strict=True):
        yield Change(f'{joint.name} seems to turn the other way than in the URDF',
                     np.diag(1 - 2 * one))
    if len(chain.joints) >= 3:
        coupled = same.copy()
        coupled[2, 1] = 1.0
        yield Change(
            f'{chain.joints[2].name} seems to be counted from the horizontal, as some controllers '
            f'do: add {chain.joints[1].name} to it', coupled)
    other = OTHER_SIDE['eye_in_hand' if on_flange else 'eye_on_base']
    yield Change(f'set calibration_type to {other}', same, other_side=True)
    for unit in (1e-3, 1e3):
        yield Change('the unit of what the sensor measures seems to be wrong', same, unit=unit)
