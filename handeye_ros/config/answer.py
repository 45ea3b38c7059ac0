"""What is asked of an answer, where it goes, and what shows it: limits to the page."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.config.parameter import key

SAVE_FORMATS = ('yaml', 'urdf', 'launch', 'shell', 'easy_handeye2', 'matrix', 'json', 'kuka',
                'fanuc', 'abb', 'ur', 'staubli', 'yaskawa')


@dataclass(frozen=True)
class LimitsConfig:
    """What is too uncertain or too inconsistent to publish."""

    translation: float = key(5e-3, 'Largest 1-sigma of the translation in its worst direction '
                             '(m).', minimum=0.0, maximum=1.0)
    rotation: float = key(2e-2, 'Largest 1-sigma of the rotation about its worst axis (rad).',
                          minimum=0.0, maximum=1.0)
    scatter: float = key(8.0, 'Largest RMS residual of a trusted answer, as a multiple of what '
                         'the configured noise makes.', minimum=1.0, maximum=1e6)
    residual: float = key(1e-3, 'Largest RMS residual of a trusted answer (m).',
                          minimum=0.0, maximum=1.0)


@dataclass(frozen=True)
class SaveConfig:
    """What is written of an answer."""

    formats: tuple[str, ...] = key(
        ('yaml',), 'The forms in which an answer is saved; calibration.yaml is always '
        'among them.', choices=SAVE_FORMATS, length=tuple(range(1, len(SAVE_FORMATS) + 1)))


@dataclass(frozen=True)
class GuidanceConfig:
    """What is enough, and where a proposed pose may be."""

    accuracy: float = key(3e-4, 'Wanted 1 sigma of points that the transform maps, over the '
                          'field of view (m): with it, the samples are enough.',
                          minimum=1e-6, maximum=0.1)
    reach: float = key(0.3, 'Largest distance of a proposed position of the flange from that '
                       'of the first sample (m).', minimum=0.0, maximum=5.0)
    tilt: float = key(0.44, 'Largest tilt of the viewing direction of a proposed pose, from '
                      'that of the first sample (rad).', minimum=0.05, maximum=1.2)
    turn: float = key(1.75, 'Largest turn of a proposed pose about the viewing direction, from '
                      'the first sample (rad).', minimum=0.0, maximum=3.15)


@dataclass(frozen=True)
class VerifyConfig:
    """What the node's verification measures, and what is known of it."""

    routine: str = key('', 'What ~/verify_start measures: line, plane, point, sphere, ball_bar, '
                       'step, square or tooth; empty: nothing.')
    calibration: str = key('', 'File of the calibration that is verified; empty: the answer of '
                           'the node.')
    lengths: tuple[float, ...] = key(
        (), 'Nominal length of the ball bar, heights of the faces over the first, or pitch and '
        'height of the teeth (m).', minimum=1e-6, maximum=10.0)
    radius: float = key(0.0, 'Nominal radius of the balls (m); 0: unknown.',
                        minimum=0.0, maximum=10.0)
    reference: tuple[float, ...] = key(
        (), 'The point as a tip of the robot touched it (m, base); empty: not touched.',
        minimum=-50.0, maximum=50.0, length=(0, 3))
    aim: float = key(0.0, 'How exactly the laser is put to the point, 1 sigma (m).',
                     minimum=0.0, maximum=0.1)
    flank: float = key(0.0, "Horizontal way of a tooth's flank (m); 0: a quarter of the pitch.",
                       minimum=0.0, maximum=1.0)
    certificate: float = key(0.0, 'Expanded uncertainty (k = 2) of lengths, radius and reference '
                             "by the artefact's certificate (m).", minimum=0.0, maximum=0.1)
    near: tuple[float, ...] = key(
        (), 'Only what comes into this ball of the base takes part: x, y, z and radius (m); '
        'empty: everything.', minimum=-50.0, maximum=50.0, length=(0, 4))
    tolerance: float = key(3e-4, 'Largest error of a length that passes (m).',
                           minimum=1e-9, maximum=1.0)
    angle_tolerance: float = key(1.7453e-3, 'Largest error of an angle that passes '
                                 '(rad).', minimum=1e-9, maximum=1.0)


@dataclass(frozen=True)
class PageConfig:
    """The page for a browser at the cell."""

    port: int = key(0, 'Port of the page for a browser; 0: no page.', minimum=0, maximum=65535)
    address: str = key('127.0.0.1', 'Address that the page is served on: 127.0.0.1 for this '
                       'machine alone, 0.0.0.0 for all that can reach it; these need the token '
                       'that is printed at the start.')
