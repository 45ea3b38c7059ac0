"""Keys of the cell: profiles, target, stops, samples, tracker, noise."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.config.parameter import key, NOT_SET

# Accuracy classes of robots: 1 sigma of the smooth error of each axis (m), half of the largest
# error in data sheets.
ROBOT_CLASSES = {'calibrated': 5e-5, 'standard': 1.5e-4, 'unknown': 3e-4}
SIGNED_AXES = ('x', 'y', 'z', '-x', '-y', '-z')


@dataclass(frozen=True)
class ProfileConfig:
    """How to read the messages of the profiler's driver."""

    unit: str = key('m', 'Unit of the coordinates in the profile messages.', choices=('m', 'mm'))
    axes: tuple[str, ...] = key(
        ('x', 'z'), 'Two signed axes of the message that span the sensor plane: along the '
        'laser line, and range.', choices=SIGNED_AXES, length=(2,))
    range_sign: int = key(
        1, '1 if the range grows away from the sensor, -1 if it grows towards it.',
        choices=(1, -1), minimum=-1, maximum=1)
    rows: str = key(
        'auto', 'What the rows of a message (its height) are: points of one profile, or profiles; '
        'auto: profiles where each runs along the whole line.',
        choices=('auto', 'points', 'profiles'))
    period: float = key(
        0.0, 'Time between the profiles of one message (s); 0: unknown, and only those messages '
        'are used during which the robot stood still.', minimum=0.0, maximum=60.0)
    exposure: float = key(0.0, 'Time that one profile averages over (s), of a robot that moves '
                          '(sampling.mode moving).', minimum=0.0, maximum=0.1)
    stamp: str = key('first', 'Which profile of a message its stamp belongs to.',
                     choices=('first', 'middle', 'last'))
    invalid: tuple[float, ...] = key(
        (), 'Ranges that mean no return, in the unit of the message, such as 0 or -327.68.',
        minimum=-1e9, maximum=1e9, length=(0, 1, 2, 3, 4))


@dataclass(frozen=True)
class TargetConfig:
    """The target that the laser line crosses."""

    type: str = key(  # noqa: A003
        'plate', 'The target: plate, line, plane, sphere or wedge; from files: points, hand_eye '
        'or tracker.')
    radius: float = key(0.0, 'Radius of the sphere in m; 0: unknown, estimated.',
                        minimum=0.0, maximum=10.0)
    size: tuple[float, ...] = key(
        (), 'Lengths of the plate along its edges p and q in m; empty: unknown, and only the '
        'two edges that meet in the corner are used.', minimum=0.0, maximum=10.0, length=(0, 2))
    radius_std: float = key(5e-5, '1 sigma of the stated radius of the sphere (m).',
                            minimum=0.0, maximum=0.1)
    size_std: float = key(1e-4, '1 sigma of each of the stated lengths of the plate (m).',
                          minimum=0.0, maximum=0.1)
    edge_angle_std: float = key(3e-4, '1 sigma of the angle between the edges of the plate '
                                '(rad).', minimum=0.0, maximum=0.1)
    setback_std: float = key(3e-5, '1 sigma of how far the seen end of a face lies inside its '
                             'sharp edge: deburring, smoothing (m).', minimum=0.0, maximum=0.01)
    edge_angle_free: bool = key(False, 'Estimate the angle between the edges of the plate '
                                'instead of taking it as a right angle.')
    angles: str = key('', 'How a table of poses writes orientations, such as kuka-abc, fanuc-wpr, '
                      'abb-quaternion, ur-rotation-vector, staubli-rxryrz, yaskawa-rxryrz; '
                      'empty: quaternion x y z w, or roll pitch yaw, as its columns say.')
    use_face: bool = key(False, 'Use the face beside the straight edge (line) too; it must be '
                         'flat.')


@dataclass(frozen=True)
class SamplingConfig:
    """When the robot counts as standing still, and which part of a stop is used."""

    mode: str = key('still', 'When a sample is taken: automatically at every stop of the robot '
                    '(still), when asked by ~/take_sample or ~/take (manual), or of single '
                    'profiles while the robot moves (moving).',
                    choices=('still', 'manual', 'moving'))
    still_time: float = key(0.5, 'The robot stands still when its pose has not changed for '
                            'this long (s).', minimum=0.05, maximum=60.0)
    still_translation: float = key(5e-4, 'Largest change of position of a robot that stands '
                                   'still (m).', minimum=0.0, maximum=0.1)
    still_rotation: float = key(2e-3, 'Largest change of orientation of a robot that stands '
                                'still (rad).', minimum=0.0, maximum=0.1)
    settle_time: float = key(0.1, 'Profiles this soon after the robot stopped, or this shortly '
                             'before it starts, are left out (s).', minimum=0.0, maximum=10.0)
    max_pose_gap: float = key(0.5, 'Poses further apart than this around a profile are too '
                              'sparse to interpolate (s).', minimum=1e-3, maximum=60.0)
    min_points: int = key(20, 'Fewest points of a face or an arc in one profile.',
                          minimum=5, maximum=100000)
    min_crossing_angle: float = key(0.44, 'A laser line that crosses an edge at a smaller '
                                    'angle is not used (rad).', minimum=0.0, maximum=1.5)
    new_translation: float = key(
        8e-3, 'A stop nearer than this to an earlier one (m), and turned by less than '
        'new_rotation, brings nothing new and is not used; 0: every stop is used.',
        minimum=0.0, maximum=1.0)
    new_rotation: float = key(
        0.05, 'A stop turned by less than this against an earlier one (rad), and nearer than '
        'new_translation, brings nothing new and is not used; 0: every stop is used.',
        minimum=0.0, maximum=3.15)

    @property
    def by_itself(self) -> bool:
        """Return whether samples are taken automatically."""
        return self.mode != 'manual'

    @property
    def moving(self) -> bool:
        """Return whether samples are taken while the robot moves."""
        return self.mode == 'moving'


@dataclass(frozen=True)
class SamplesConfig:
    """The samples used for the answer."""

    exclude: tuple[int, ...] = key(
        (), 'Numbers of the samples that are left out; taking a number away brings it back.',
        minimum=1, maximum=10**6, whole=True)


@dataclass(frozen=True)
class TrackerConfig:
    """Properties of the laser tracker and of the arm that it measures (target.type tracker)."""

    file: str = key('tracker.csv', 'Name of the file of reflector points beside the bag.')
    noise: float = key(2e-5, 'Noise of a reflector centre, each axis (m).',
                       minimum=1e-9, maximum=0.01)
    h0: float = key(NOT_SET, 'Height of the reflector above the top of P3 (m).',
                    minimum=-10.0, maximum=10.0)
    h1: float = key(NOT_SET, 'Height of the top of P3 above the origin of frame 2 (m).',
                    minimum=-10.0, maximum=10.0)
    first_reading: float = key(NOT_SET, 'Reading of P3 at the first pose of the bag (m).',
                               minimum=-100.0, maximum=100.0)
    direction: tuple[float, ...] = key(
        (0.0, 1.0, 0.0), 'Direction of the sweep in the sensor frame, roughly.',
        minimum=-1.0, maximum=1.0, length=(3,))


@dataclass(frozen=True)
class NoiseConfig:
    """Prior noise, 1 sigma; the data correct it."""

    sensor: float = key(3e-5, 'Range noise of one profile point (m).',
                        minimum=1e-9, maximum=0.01)
    distortion: float = key(2e-5, "Smooth error of the sensor's field, its linearity (m).",
                            minimum=0.0, maximum=0.01)
    line_bend: float = key(1e-4, 'Bend of the laser line out of its plane, at its ends (m).',
                           minimum=0.0, maximum=0.01)
    flatness: float = key(2e-5, 'Smooth deviation of the faces of the target from flat (m).',
                          minimum=0.0, maximum=0.01)
    robot_translation: float = key(3e-5, 'Repeatability of the flange position, each axis (m).',
                                   minimum=0.0, maximum=0.01)
    robot_rotation: float = key(7e-5, 'Repeatability of the flange orientation, each axis '
                                '(rad).', minimum=0.0, maximum=0.01)
    stamps: float = key(1e-4, 'Jitter of the stamps of profiles, of a robot that moves (s).',
                        minimum=0.0, maximum=0.1)
    robot_smooth: float = key(1.5e-4, 'Error of the robot that varies smoothly over its '
                              'workspace, each axis (m); the data corrects it.',
                              minimum=0.0, maximum=0.01)
    robot_class: str = key('', 'Accuracy of the robot by its data sheet: calibrated (0.1 mm), '
                           'standard (0.3 mm) or unknown; sets robot_smooth where that is not '
                           'given with it; empty: as robot_smooth says.',
                           choices=('', *ROBOT_CLASSES))
    robot_scale: float = key(7e-4, 'Relative error of the lengths of the robot.',
                             minimum=0.0, maximum=0.1)
