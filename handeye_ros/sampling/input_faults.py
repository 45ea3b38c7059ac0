# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What is wrong with the messages and stops of a session, in words.

A `require_` raises its error; one that is returned (`_error`) may also be shown by the node, as
notices and warnings are, while the session goes on. They stand in the order in which a stop meets
them: what the topics carry, the poses of now, the end of a recording, the stops that were
evaluated. Of single messages that were dropped the Stream tells (stream.py).
"""
from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
import math
from typing import Any

from handeye_ros import se3, targets
from handeye_ros.config import Config, SamplingConfig, UNNAMED_FRAME
from handeye_ros.data import AnyProfile, Array, NS, Sample, TimedPose
from handeye_ros.errors import DataError, InputError
from handeye_ros.sampling.stops import Motion, Stop, StopFinder
from handeye_ros.sampling.stream import REORDER_TIME, Stream
from handeye_ros.words import count_of
import numpy as np

POSES_MISSING_TIME = 0.25  # s without a pose, while profiles come: then the robot may be anywhere
SAME_PLANE = 5e-4  # m: largest difference across the light plane between profiles of one plane
MAX_OUT_OF_PLANE = 1e-3  # m: of profiles, from the plane of their axes, before it is told
MIN_TILTED, TILT_REST = 8, 0.03  # stops that show a tilted plane; what it leaves unexplained
MAX_REPEATS = 20  # of one stamp in a row: its clock stands still
MAX_FLANGE_DISTANCE = 50.0  # m: no flange is there, it is another unit


def base_frame_error(base_frame: str, config: Config) -> InputError | None:
    """Return the error of poses in another base frame than that of the settings, or None."""
    wanted = config.robot_base_frame.lstrip('/')
    if wanted and base_frame and wanted != base_frame:
        return InputError(f'the poses are given in "{base_frame}", but robot_base_frame is '
                          f'"{wanted}": set it to {base_frame}, or leave it out; it is then that '
                          'of the poses', code='base_frame')
    return None


def tilted_plane_error(stops: Iterable[Stop], config: Config) -> InputError | None:
    """
    Return the error of profiles in a plane that is tilted against their axes, None if it is not.

    By the centroids of the samples, see Sample. Of a tilted plane the distance across it follows
    from the other coordinates; an encoder's position does not.
    """
    centroids = _centroids(stops)
    if len(centroids) < MIN_TILTED:
        return None
    across, along, distance = np.transpose(centroids)
    if np.ptp(across) < SAME_PLANE:
        return None
    plane = np.column_stack([along, distance, np.ones(len(across))])
    residual = across - plane @ np.linalg.lstsq(plane, across, rcond=None)[0]
    if not np.std(residual) < TILT_REST * np.std(across):
        return None
    return InputError(
        f'the profiles lie between {across.min() * 1e3:.1f} and {across.max() * 1e3:.1f} mm '
        f'beside the plane of {" and ".join(config.profile.axes)} in their frame, as in a light '
        'plane that is tilted against it: let the driver publish them in a frame of the light '
        'plane; a static transform can hold the tilt', code='tilted_plane')


def frame_change_notice(streams: Iterable[Stream[Any]], has_samples: bool) -> str:
    """Return in words that another frame replaced the first, which gave no sample; or ''."""
    for stream in streams:
        if stream.successor and not has_samples:
            return (f'only {stream.kind}s of frame "{stream.successor}" come now, and none of '
                    f'"{stream.frame}" gave a sample: the session begins anew')
    return ''


def late_streams(streams: Iterable[Stream[Any]]) -> tuple[str, ...]:
    """Return which streams (poses, profiles) are dropped because their stamps are too old."""
    return tuple(f'{stream.kind}s' for stream in streams if stream.late)


def unusable_poses_error(poses: Stream[TimedPose], flange_distance: float) -> DataError | None:
    """
    Return the error of poses whose clock stands still, or in another unit, or None.

    flange_distance: of the last pose from the base (m).
    """
    if poses.repeats >= MAX_REPEATS:
        return DataError('all poses have the same stamp: the clock of their driver stands still; '
                         'with use_sim_time, /clock must be published', code='late_poses')
    if flange_distance > MAX_FLANGE_DISTANCE:
        return DataError(f'the flange is {flange_distance:.0f} m from the base of the robot: the '
                         'positions seem to be in mm; publish them in metres',
                         code='position_unit')
    return None


def require_usable_poses(poses: Stream[TimedPose], flange_distance: float, config: Config) -> None:
    """Raise DataError as in unusable_poses_error, or where no pose has come (code no_poses)."""
    if error := unusable_poses_error(poses, flange_distance):
        raise error
    if poses.frame is None:  # one that is held was received too
        keys = config.key_of_poses or 'robot_base_frame and robot_effector_frame'
        raise DataError(f'no flange pose was received on {config.topic_of_poses}: start the robot '
                        f'driver, or set {keys}', code='no_poses')


def require_current_poses(poses: Stream[TimedPose], profiles: Stream[AnyProfile]) -> None:
    """Raise DataError where the poses come late or no longer (code late_poses, silent_poses)."""
    if poses.late:
        raise DataError('the robot position is not known: its poses have older stamps than those '
                        'before', code='late_poses')
    # of stamps: more than REORDER_TIME may be clocks that differ; the node asks its own clock
    silence = (profiles.latest - poses.latest) / NS
    if max(POSES_MISSING_TIME, 5 * poses.period) < silence < REORDER_TIME / NS:
        raise silent_poses_error(silence)


def silent_poses_error(seconds: float) -> DataError:
    """Return the refusal of a sample while no pose has come for a time (s)."""
    return DataError(f'no pose has come for {seconds:.1f} s, so the robot position is not known: '
                     'check the robot driver, and take the sample again', code='silent_poses')


def not_standing_error(motion: Motion | None, sampling: SamplingConfig) -> DataError:
    """Return the refusal of a sample before a robot in this motion has made a stop or a pass."""
    if sampling.moving:
        return DataError('the pass has just begun: sweep on, and take the sample in a second',
                         code='moving')
    how = motion.sentence if motion else 'too few poses have come'
    return DataError(f'the robot must stand still for {sampling.still_time:g} s, and {how}: wait, '
                     'and take the sample again', code='moving')


def unrequested_stops_notice(count: int) -> str:
    """Return in words that the robot stopped `count` times, but no sample was requested; or ''."""
    return (f'the robot stood still {count_of(count, "time")}, but no sample was requested: '
            'sampling.mode is manual; call ~/take_sample at each stop, send ~/take, or set '
            'sampling.mode to still') if count else ''


def require_long_rests(count: int, finder: StopFinder, config: Config) -> None:
    """
    Refuse a recording with too few stops for the target, and more rests that were too short.

    count: of its stops. Raises DataError, its code no_stops.
    """
    sampling = config.sampling
    if sampling.mode == 'still' and finder.short_rest_count > count and (
            0 < count < targets.target_for(config).min_samples):
        raise DataError(f'the robot stood still for {sampling.still_time:g} s only '
                        f'{count_of(count, "time")}, and {finder.short_rest_count} times for '
                        'less: stay longer at each stop, or lower sampling.still_time',
                        code='no_stops')


def no_stops_error(poses: Stream[TimedPose], finder: StopFinder) -> DataError:
    """Return the refusal of poses that make neither a stop nor a pass."""
    sampling = finder.sampling
    if poses.period > sampling.max_pose_gap:
        return DataError('the flange poses, or the joint values that give them, come only every '
                         f'{poses.period:.2g} s, more than sampling.max_pose_gap '
                         f'({sampling.max_pose_gap:g} s): publish them more often, also while the '
                         'robot stands still, or raise sampling.max_pose_gap', code='sparse_poses')
    if sampling.moving:
        return DataError(f'the {poses.count} poses make no sweep: nowhere are there '
                         f'{min(sampling.still_time, 1.0):g} s of them without a gap: record a '
                         'longer sweep', code='no_stops')
    return DataError(f'the robot never stood still for {sampling.still_time:g} s in {poses.count} '
                     f'poses, but for {finder.longest_rest_ns / NS:.2g} s at most: stop at each '
                     'sample, and let its poses be sent while it stands, too, or lower '
                     'sampling.still_time; if its poses are noisy, raise '
                     'sampling.still_translation and sampling.still_rotation; if the robot moves '
                     'all the time, set sampling.mode to moving', code='no_stops')


def duplicate_pose_reason(sample: Sample, others: Iterable[Stop], config: Config) -> str:
    """Return in words which of other stops has the pose of a sample, '' if none."""
    limits = config.sampling
    for other in others:
        if other.sample:
            T = se3.inverse(other.sample.T_base_flange) @ sample.T_base_flange
            away, angle = math.hypot(*T[:3, 3]), float(se3.angle(T[:3, :3]))
            if away < limits.new_translation and angle < limits.new_rotation:
                return (f'{away * 1e3:.0f} mm and {np.degrees(angle):.1f} degrees from '
                        f'sample {other.number}: it brings nothing new')
    return ''


def stop_warnings(expired_count: int, stops: Collection[Stop], last_number: int, config: Config
                  ) -> Iterator[str]:
    """
    Yield a sentence about stops that were dropped, and one about wrong numbers to exclude.

    expired_count: of the dropped ones; last_number: the largest that a stop has had.
    """
    if expired_count:
        yield f'gave up {count_of(expired_count, "stop")}, the oldest that waited for profiles'
    # a sample that was removed had a number
    missing = [n for n in config.samples.exclude if n > last_number]
    if missing and stops:
        yield f'samples.exclude names no stop of these: {missing}'


def frame_warnings(frame: str | None, stops: Iterable[Stop], config: Config) -> Iterator[str]:
    """
    Yield what is unusual in the frame of the profiles, one sentence each.

    frame: its name, None before the first profile.
    """
    if frame == '':
        yield f'the profiles have no frame_id: the result calls their frame "{UNNAMED_FRAME}"'
    out_of_plane = max((abs(float(across)) for across, *_ in _centroids(stops)), default=0.0)
    if out_of_plane > MAX_OUT_OF_PLANE:
        yield (f'the profiles lie up to {out_of_plane * 1e3:.1f} mm beside the plane of '
               f'{" and ".join(config.profile.axes)} in their frame: that coordinate is not '
               'used, and the result holds for points in the plane')


def _centroids(stops: Iterable[Stop]) -> list[Array]:
    """Return the centroids (3,) of the samples, where they are known."""
    return [stop.sample.centroid for stop in stops
            if stop.sample and stop.sample.centroid is not None]
