"""Reflector points of a laser tracker in a file, with the bag of the sweep (Jing 2020)."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
import math
from pathlib import Path

from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.errors import BadValueError, InputError
from handeye_ros.estimation.outliers import adjust
from handeye_ros.frames import sensor_axes
from handeye_ros.published import jing2020
from handeye_ros.results.calibration_file import input_values
from handeye_ros.results.truth_file import FIELD, field_points
from handeye_ros.tables import Table, TableError
from handeye_ros.tabulated import tracker_estimate, tracker_model
from handeye_ros.tabulated.method import Answer, FileMethod, Index, Input, ReadBag
from handeye_ros.tabulated.sweeps import sweep_from
from handeye_ros.tabulated.tracker_model import Seen, State, Sweep, SWEPT
import numpy as np
from numpy.typing import NDArray

REFLECTED = {'arc': 'arc', 'line': 'line', 'spots_c': 'face_c', 'spots_d': 'face_d'}
CENTRE = 'centre'  # of the ball, by the tracker: the mean of its rows, always used
NO_SAMPLE = -1

Masks = Mapping[str, NDArray[np.bool_]]


@dataclass(frozen=True, eq=False)
class Session:
    """
    The measurements of both instruments.

    of: for each part by name, the index of each point's sample; samples: row of the file or
    stamp of the profile, and its kind.
    """

    reflector: jing2020.Tracker
    sweep: Sweep
    of: Mapping[str, Index]
    samples: tuple[tuple[int, str], ...]

    def seen(self, config: Config) -> Seen:
        """Return the measurements in the form of the model."""
        return Seen(self.reflector, self.sweep, config.tracker.noise)

    def chain(self, config: Config) -> jing2020.Result:
        """Return the published answer; raises DataError."""
        return jing2020.solve(self.reflector, self.sweep.published, direction(config))


def direction(config: Config) -> Array:
    """Return the direction of the sweep as a unit vector (3,): x along the line, z the range."""
    given = np.array(config.tracker.direction)
    if not given.any():
        raise BadValueError('tracker.direction', list(given), 'a direction that is not zero')
    return np.asarray(sensor_axes(config)[:3, :3].T @ given / np.linalg.norm(given))


def _read(path: Path, config: Config, read_bag: ReadBag) -> Input[Session]:
    direction(config)
    file = (path if path.is_dir() else path.parent) / config.tracker.file
    recording = read_bag(path, config)
    if not file.is_file():
        raise TableError(file, 'no such file: put the reflector points beside the bag, or set '
                         'tracker.file')
    known = config.tracker
    missing = [f'tracker.{name}' for name in ('h0', 'h1', 'first_reading')
               if math.isnan(getattr(known, name))]
    if missing:
        raise InputError(f'{" and ".join(missing)} must be set: the answer changes by their full '
                         'size, so they have no default; see config/tracker.yaml')
    reflector = tracker_estimate.read(file, known.h0, known.h1)
    sweep = sweep_from(recording.profiles, recording.poses, config, known.first_reading)
    session = _session(reflector, sweep, np.array(Table(file).text('kind')))
    return Input(session, recording.profiles[0].frame_id or 'laser',
                 (*recording.inputs, input_values(file)), recording.warnings)


def _session(reflector: jing2020.Tracker, sweep: Sweep, kinds: NDArray[np.str_]) -> Session:
    """Return the session with numbered samples: first the rows of the file, then profiles."""
    rows = [(row, str(kind)) for row, kind in enumerate(kinds, 1) if kind != 'ball']
    row_kinds = np.array([kind for _, kind in rows])
    of = {part: np.flatnonzero(row_kinds == kind) for part, kind in REFLECTED.items()}
    of[CENTRE] = np.array([NO_SAMPLE])
    stamps = np.unique(np.concatenate([sweep.stamps[part] for part in SWEPT]))
    of |= {part: len(rows) + np.searchsorted(stamps, sweep.stamps[part]) for part in SWEPT}
    of_ball = np.isin(stamps, sweep.stamps['ball'])
    profiles = [(int(stamp), 'swept ball' if ball else 'swept faces')
                for stamp, ball in zip(stamps, of_ball, strict=True)]
    return Session(reflector, sweep, of, (*rows, *profiles))


def _solve(data: Session, config: Config) -> Answer[Session]:
    found = tracker_estimate.solve(data.reflector, data.sweep, config.tracker.noise,
                                   direction(config))
    good = np.isin(np.arange(len(found.distances)), found.used)
    of, count = tracker_model.sources(data.of), len(data.samples)
    mine, total = of != NO_SAMPLE, np.bincount(of[of != NO_SAMPLE], minlength=count)
    believed = np.bincount(of[mine & good], minlength=count)
    squares = np.bincount(of[mine], found.distances[mine] ** 2, minlength=count)
    used = 2 * believed >= total  # a point of a profile may be wrong, the others not
    target = {'radius': found.radius, 'face_angle': found.face_angle, 'skew_angle': found.skew}
    return Answer(found.T_flange_sensor, found.covariance, used,
                  np.sqrt(squares / np.maximum(total, 1)), _rms(found.distances[found.used]),
                  _rms(found.left_out), _agreed(data, good, used), target)


def _rms(values: Array) -> float:
    return float(np.sqrt((values ** 2).mean()))


def _agreed(data: Session, good: NDArray[np.bool_], used: NDArray[np.bool_]) -> Session:
    """Return the session of used samples, without wrong points; good: (n,) of all distances."""
    ends = np.cumsum([len(of) for of in data.of.values()])
    points = dict(zip(data.of, np.split(np.arange(ends[-1]), ends[:-1]), strict=True))
    wrong = tracker_model.sources(points)[~good]
    return _subset(_select(data, {part: ~np.isin(points[part], wrong) for part in points}),
                   np.flatnonzero(used))


def _subset(data: Session, keep: Index) -> Session:
    part = _select(data, {name: np.isin(of, keep) for name, of in data.of.items()})
    of = {name: np.searchsorted(keep, of) for name, of in part.of.items()}
    return replace(part, of={**of, CENTRE: data.of[CENTRE]},
                   samples=tuple(data.samples[i] for i in keep))


def _select(data: Session, masks: Masks) -> Session:
    """Return the points where masks are true; the ball's centre by the tracker always remains."""
    reflector = {kind: getattr(data.reflector, kind)[masks[part]]
                 for part, kind in REFLECTED.items()}
    swept = {part: getattr(data.sweep, part)[masks[part]] for part in SWEPT}
    stamps = {part: data.sweep.stamps[part][masks[part]] for part in SWEPT}
    of = {part: of if part == CENTRE else of[masks[part]] for part, of in data.of.items()}
    return replace(data, reflector=replace(data.reflector, **reflector),
                   sweep=replace(data.sweep, **swept, stamps=stamps), of=of)


def _residuals(data: Session, X: Array, fitted: Index, measured: Index, config: Config) -> Array:
    part = _subset(data, fitted)
    seen = part.seen(config)
    start = tracker_model.start(part.chain(config), seen)
    fit = adjust(tracker_model.system(seen, given_X=True),
                 State(start.T_tracker_2, X, start.rest), tracker_model.MINIMUM)
    distances, _ = tracker_model.distances(fit.state, data.seen(config))
    return distances[np.isin(tracker_model.sources(data.of), measured)]


TRACKER = FileMethod(
    'tracker', ('eye_in_hand',),
    'measure a longer arc and line, sweep over more of ball and faces',
    _read, _solve, lambda data: data.samples, _subset, _residuals, lambda data: field_points(),
    FIELD, profiles=True)
