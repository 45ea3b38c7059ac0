"""
What to do before the sensor is roughly known: moves that a person does by the look of the laser.

The first samples are those of a fixed design, told from the first pose in axes that can be seen:
the laser line, the light plane, the viewing direction. Out of 189 turns, tilts and places an
exchange search found it to leave points mapped by plate, line and sphere least uncertain, with
the noise of a common robot (0.05 mm, 0.02 degrees).
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.estimation.method import Method
from handeye_ros.guidance.view import View
import numpy as np

# Turn about the viewing direction (degrees); tilts about the laser line and about the normal of
# the light plane, in shares of the largest; place along the line and in range, -1 to 1.
DESIGN = np.array([
    [0.0, 0.0, 0.0, 0.0, 0.0],
    [50.0, -0.57, -0.57, 0.7, 0.7],
    [50.0, 0.57, 0.57, 0.7, -0.7],
    [0.0, 0.0, -0.8, -0.7, -0.7],
    [-50.0, -0.57, 0.57, -0.7, -0.7],
    [50.0, 0.57, 0.57, -0.7, 0.7],
    [50.0, -0.57, -0.57, 0.0, -0.7],
])
PER_EDGE = 3  # stations before the other edge of a plate has its turn


@dataclass(frozen=True, eq=False)
class Move:
    """
    A move from the first pose, by the look of the laser.

    turn: rad about the viewing direction (the range axis), done first; tilt: (2,) rad about the
    laser line and about the normal of the light plane; place: (2,) where in the sensor plane the
    feature then is; edge: which of the target's edges the line crosses, from 0.
    """

    text: str
    turn: float
    tilt: Array
    place: Array
    edge: int = 0


def next_move(taken: int, method: Method, config: Config, view: View) -> Move:
    """Return the move after so many samples (one at least)."""
    mirrored = -1.0 if taken // len(DESIGN) % 2 else 1.0
    step = DESIGN[taken % len(DESIGN)] * [mirrored, 1, 1, 1, 1]
    limits = config.guidance
    turn = float(np.clip(np.radians(step[0]), -limits.turn, limits.turn))
    tilt = np.round(step[1:3] * limits.tilt, 3)
    inner = view.inner()
    place = (inner.low + inner.high) / 2 + step[3:] * inner.size / 2
    edge = taken // PER_EDGE % 2 if len(method.edges) > 1 else 0
    text = f'{_start(edge, method)}: {_turns(turn, tilt)}; {_shown(method, place, step[3:])}'
    return Move(text, turn, tilt, place, edge)


def noun(method: Method) -> str:
    """Return what the laser line has to see."""
    return 'edge' if method.edges else method.name


def _start(edge: int, method: Method) -> str:
    if len(method.edges) < 2:
        return 'from the pose of the first sample'
    return ('from the pose of the first sample, at the same edge' if edge == 0 else
            'at the other edge, that meets the first one in the corner, from where the line '
            'crosses it squarely')


def _turns(turn: float, tilt: Array) -> str:
    """Return the rotations in words."""
    parts = [f'{np.degrees(angle):+.0f} degrees about {axis}' for angle, axis in (
        (turn, 'its viewing direction'), (tilt[0], 'the laser line'),
        (tilt[1], 'the normal of the light plane')) if angle]
    return f'turn the sensor {", then ".join(parts)}' if parts else 'look squarely'


def _shown(method: Method, place: Array, share: Array) -> str:
    """Return where the feature should be seen."""
    x, z = place * 1e3
    along = ('low', 'middle', 'high')[int(np.sign(share[0])) + 1]
    near = ('near', 'middle', 'far')[int(np.sign(share[1])) + 1]
    return (f'keep the {noun(method)} in view, at the {along} end of the line and {near} '
            f'(x = {x:.0f} mm, range {z:.0f} mm)').replace('middle end', 'middle')
