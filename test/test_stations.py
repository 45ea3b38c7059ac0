"""Stations from streams of poses and profiles, whatever the order of their arrival."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from handeye_ros import se3
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, EdgePoint, Profile, Reject, Sample, TimedPose
from handeye_ros.profiles.errors import FeatureError
from handeye_ros.sampling.errors import (
    MovingError,
    NoPosesError,
    NoProfilesError,
    NoStationsError,
    NothingNewError,
    NothingToRemoveError,
    PositionUnitError,
    SilentPosesError,
    SparsePosesError,
    TwoFramesError,
)
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stations import interpolate, MAX_STATION, NS
from handeye_ros.sampling.stops import MOST_PROFILES
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from profiles import drawn, face, step_up_to, with_lost
import pytest

START = 1_700_000_000_000_000_000
MS = 1_000_000
GOOD = with_lost(drawn(step_up_to(0.002)))[::4]
BAD = with_lost(drawn(face))[::4]  # a face without an edge
CONFIG = with_values(Config(), {'sampling.new_translation': 0.0}, 'test')
MANUAL = with_values(CONFIG, {'sampling.mode': 'manual'}, 'test')


def pose(time: float, x: float = 0.0, turn: float = 0.0, frame: str = 'base') -> TimedPose:
    return TimedPose(START + round(time * NS), np.array([x, 0.2, 0.3]),
                     np.array([0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)]), frame)


def profile(time: float, points: Array = GOOD, frame: str = 'laser') -> Profile:
    return Profile(START + round(time * NS), frame, points)


def stops(*spans: tuple[float, float], rate: float = 50.0) -> list[TimedPose]:
    """Return poses of a robot that stands still during the spans (s) and moves in between."""
    poses = []
    for t in np.arange(spans[0][0], spans[-1][1] + 1e-9, 1 / rate).round(9):
        index = sum(t > end for _, end in spans)
        inside = spans[index][0] <= t
        poses.append(pose(t, x=0.1 * index if inside else 0.1 * index - 0.05 + 0.02 * (t % 1)))
    return poses


def profiles(start: float, end: float, rate: float = 20.0, points: Array = GOOD
             ) -> list[Profile]:
    return [profile(t, points) for t in np.arange(start, end, 1 / rate) + 0.003]


def played(poses: Sequence[TimedPose], profiles: Sequence[Profile], config: Config = CONFIG,
           finish: bool = True) -> Session:
    """Return a session that took both streams in the order of their stamps."""
    session = Session(config)
    for item in sorted([*poses, *profiles], key=lambda item: item.stamp):
        add(session, item)
        session.collect()
    if finish:
        session.finish()
    return session


def add(session: Session, item: TimedPose | Profile) -> None:
    if isinstance(item, TimedPose):
        session.add_pose(item)
    else:
        session.add_profile(item)


def results(session: Session) -> list[Sample | Reject]:
    """Return what became of the stops, in the order of their numbers."""
    return [outcome.result for outcome in session.outcomes]


def key(outcomes: Sequence[Sample | Reject]) -> list[tuple[object, ...]]:
    """Return all that outcomes say, to be compared."""
    return [(o.stamp, o.reason) if isinstance(o, Reject) else (
        o.stamp, o.T_base_flange.tobytes(), o.profiles,
        tuple((f.point.tobytes(), f.std) if isinstance(f, EdgePoint) else f.centre.tobytes()
              for f in o.features)) for o in outcomes]


# -- stations


def test_every_stop_gives_a_sample_with_its_pose_and_its_first_stamp() -> None:
    session = played(stops((0, 1), (2, 3), (4, 5.2)), profiles(0, 5.2))
    assert [round((s.stamp - START) / NS, 3) for s in session.samples] == [0.103, 2.103, 4.103]
    assert [round(float(s.T_base_flange[0, 3]), 6) for s in session.samples] == [0.0, 0.1, 0.2]
    assert not session.rejects and not session.warnings
    assert session.frame_id == 'laser'


@pytest.mark.parametrize('still_time', [0.3, 0.8])
def test_a_stop_shorter_than_still_time_is_none(still_time: float) -> None:
    config = with_values(CONFIG, {'sampling.still_time': still_time}, 'test')
    session = played(stops((0, 0.5), (2, 3)), profiles(0, 3), config)
    assert len(session.samples) == (2 if still_time < 0.5 else 1)


def test_a_robot_that_creeps_does_not_stand_still() -> None:
    creeping = [pose(t, x=9e-4 * t) for t in np.arange(0, 4, 0.02)]  # 0.9 mm/s
    assert len(played(creeping, profiles(0, 4)).samples) >= 4, 'the limit is 0.5 mm'
    strict = with_values(CONFIG, {'sampling.still_translation': 1e-4}, 'test')
    assert not played(creeping, profiles(0, 4), strict).samples
    turning = [pose(t, turn=8e-3 * t) for t in np.arange(0, 4, 0.02)]
    assert not played(turning, profiles(0, 4)).samples


def test_the_sign_of_a_quaternion_is_no_motion() -> None:
    poses = [replace(p, quaternion=p.quaternion * (-1) ** i)
             for i, p in enumerate(stops((0, 1)))]
    sample, = played(poses, profiles(0, 1)).samples
    assert np.allclose(sample.T_base_flange[:3, :3], np.eye(3))


def test_profiles_near_the_ends_of_a_stop_are_left_out() -> None:
    for settle in (0.0, 0.1, 0.3):
        config = with_values(CONFIG, {'sampling.settle_time': settle}, 'test')
        sample, = played(stops((0, 1)), profiles(0, 1), config).samples
        times = np.arange(0, 1, 0.05) + 0.003
        assert sample.profiles == ((times >= settle) & (times <= 1 - settle)).sum()


def test_a_gap_in_the_poses_ends_a_stop() -> None:
    poses = [p for p in stops((0, 3)) if not 1.0 < (p.stamp - START) / NS < 1.7]
    session = played(poses, profiles(0, 3))
    assert len(session.samples) == 2
    wide = with_values(CONFIG, {'sampling.max_pose_gap': 1.0}, 'test')
    assert len(played(poses, profiles(0, 3), wide).samples) == 1


def test_profiles_beyond_the_poses_are_never_used() -> None:
    config = with_values(CONFIG, {'sampling.settle_time': 0.0}, 'test')
    session = played(stops((1, 2)), profiles(0, 3), config)
    sample, = session.samples
    assert START + NS <= sample.stamp and sample.profiles == 20


def test_a_long_stop_uses_its_first_seconds() -> None:
    length = MAX_STATION / NS
    session = played(stops((0, length + 5)), profiles(0, length + 5, rate=5.0))
    sample, = session.samples
    assert sample.profiles <= 5 * length + 1 and sample.stamp < START + NS


def test_a_fast_sensor_is_thinned_out_evenly() -> None:
    session = played(stops((0, 2)), profiles(0, 2, rate=500.0), finish=True)
    sample, = session.samples
    assert sample.profiles == MOST_PROFILES < 900
    edge, = (f for f in sample.features if isinstance(f, EdgePoint))
    few, = played(stops((0, 2)), profiles(0, 2, rate=50.0)).samples
    other, = (f for f in few.features if isinstance(f, EdgePoint))
    assert np.allclose(edge.point, other.point, atol=1e-9)


def test_a_stop_without_profiles_or_without_a_target_is_refused_with_a_reason() -> None:
    session = played(stops((0, 1), (2, 3), (4, 5)), [
        *profiles(0, 1), *profiles(2, 3, points=BAD)])
    assert len(session.samples) == 1
    no_edge, no_profile = session.rejects
    assert 'edge' in no_edge.reason and no_edge.stamp == START + 2 * NS
    assert 'no profile' in no_profile.reason and no_profile.stamp == START + 4 * NS


def test_most_profiles_of_a_stop_must_show_the_target() -> None:
    for good, count in ((12, 1), (6, 0)):
        mixed = [replace(p, points=GOOD if i < good else BAD)
                 for i, p in enumerate(profiles(0.1, 0.9))]
        session = played(stops((0, 1)), mixed)
        assert len(session.samples) == count and len(session.rejects) == 1 - count
        if count:
            assert session.samples[0].profiles == good


# -- the order of arrival


STREAM_POSES = stops((0, 1), (2, 2.8), (3.5, 4.5), rate=25.0)
STREAM_PROFILES = [*profiles(0.02, 2.9, rate=8.0), *profiles(3.4, 4.5, rate=8.0, points=BAD)]
IN_ORDER = key(results(played(STREAM_POSES, STREAM_PROFILES)))


@settings(max_examples=30)
@given(st.lists(st.booleans(), min_size=len(STREAM_POSES) + len(STREAM_PROFILES),
                max_size=len(STREAM_POSES) + len(STREAM_PROFILES)), st.booleans())
def test_the_order_of_arrival_changes_nothing(pose_next: list[bool], collecting: bool) -> None:
    session, streams = Session(CONFIG), [list(STREAM_PROFILES), list(STREAM_POSES)]
    outcomes: list[Sample | Reject] = []
    for which in pose_next:
        stream = streams[which] or streams[not which]
        add(session, stream.pop(0))
        if collecting:
            outcomes += session.collect()
    outcomes += session.finish()
    assert key(outcomes) == IN_ORDER
    assert key([*session.samples, *session.rejects]) == key([
        *(o for o in outcomes if isinstance(o, Sample)),
        *(o for o in outcomes if isinstance(o, Reject))])


@pytest.mark.parametrize('first', ['poses', 'profiles'])
def test_one_whole_stream_may_come_before_the_other(first: str) -> None:
    session = Session(CONFIG)
    order = [STREAM_POSES, STREAM_PROFILES]
    for stream in order if first == 'poses' else order[::-1]:
        for item in stream:
            add(session, item)
    assert key(session.finish()) == IN_ORDER


def test_a_station_is_told_once_and_as_soon_as_both_streams_have_passed_it() -> None:
    session, told = Session(CONFIG), []
    for item in sorted([*STREAM_POSES, *STREAM_PROFILES], key=lambda item: item.stamp):
        add(session, item)
        told += [(o, item.stamp) for o in session.collect()]
    told += [(o, 0) for o in session.finish()]
    assert key([o for o, _ in told]) == IN_ORDER
    assert START + NS < told[0][1] < START + round(1.3 * NS)
    assert session.collect() == [] == session.finish()


def test_profiles_of_the_past_are_forgotten() -> None:
    session = Session(CONFIG)
    most = 0
    for item in sorted([*stops((0, 60), rate=10.0), *profiles(0, 60)],
                       key=lambda item: item.stamp):
        add(session, item)
        session.collect()
        most = max(most, len(session._profiles))
    assert most < 1.2 * 20 * MAX_STATION / NS


# -- what is not as it should be


def test_time_that_goes_backwards_is_dropped_and_counted() -> None:
    session = played(stops((0, 1)), profiles(0, 1), finish=False)
    for _ in range(3):
        session.add_pose(pose(0.5, x=3.0))
    session.add_profile(profile(0.4, BAD))
    session.add_pose(pose(1.0, x=3.0))  # the same stamp again
    session.finish()
    assert len(session.samples) == 1 and session.samples[0].T_base_flange[0, 3] == 0
    kinds = [(w.split(' whose')[0], w.rsplit('(', 1)[1]) for w in session.warnings]
    assert kinds == [('dropped a pose', '4 times)'), ('dropped a profile', '1 times)')]


@pytest.mark.parametrize('jump', [-1e9, -30.0, 1.5, 30.0, 1e9])
@pytest.mark.parametrize('kind', ['pose', 'profile'])
@pytest.mark.parametrize('place', [0, 7, 8])
def test_one_wild_stamp_changes_nothing_but_that_message(
        jump: float, kind: str, place: int) -> None:
    streams: dict[str, list[TimedPose | Profile]] = {
        'pose': [*STREAM_POSES], 'profile': [*STREAM_PROFILES]}
    wild = streams[kind][place]
    items = sorted([*STREAM_POSES, *STREAM_PROFILES], key=lambda item: item.stamp)
    outcomes = []
    for left_out in (True, False):
        session = Session(CONFIG)
        for item in items:
            if item is not wild:
                add(session, item)
            elif not left_out:
                add(session, replace(item, stamp=item.stamp + round(jump * NS)))
            session.collect()
        session.finish()
        outcomes.append(key(results(session)))
        assert not session.late
    assert outcomes[0] == outcomes[1]
    # the first of all may be early: nothing tells that it is
    assert len(session.warnings) == (0 if place == 0 and jump < 0 else 1)


def test_a_sensor_that_is_triggered_once_at_each_stop() -> None:
    session = Session(MANUAL)
    for stop in (0, 20, 40):
        for t in np.arange(stop, stop + 1, 0.02):
            add(session, pose(t, x=0.01 * stop))
        add(session, profile(stop + 0.5))
        sample = session.take_sample()
        assert (sample.profiles, sample.stamp) == (1, START + round((stop + 0.5) * NS))
    assert len(session.samples) == 3 and not session.warnings


def test_a_clock_that_is_set_goes_on() -> None:
    late = [*stops((100, 101)), *profiles(100, 101)]
    session = played([*stops((0, 1)), *late], [*profiles(0, 1)])
    assert len(session.samples) == 2 and not session.warnings


def test_a_bag_that_starts_again_is_late_until_the_samples_are_cleared() -> None:
    session = played(stops((0, 1)), profiles(0, 1), finish=False)
    assert session.late == ()
    add(session, pose(0.0))
    assert session.late == ('poses',)
    add(session, profile(0.0))
    assert session.late == ('poses', 'profiles')
    session.clear()
    assert session.late == ()


@pytest.mark.parametrize(('frame', 'beside', 'name', 'words'), [
    ('laser', 0.0005, 'laser', None), ('', 0.0, 'sensor', 'have no frame_id'),
    ('laser', -0.012, 'laser', 'up to 12.0 mm beside the plane of x and z')])
def test_what_is_odd_about_the_frame_of_the_profiles_is_told(
        frame: str, beside: float, name: str, words: str | None) -> None:
    odd = [replace(p, frame_id=frame, beside=beside) for p in profiles(0, 1)]
    session = played(stops((0, 1)), odd)
    assert len(session.samples) == 1 and session.frame_id == name
    assert len(session.warnings) == (words is not None)
    assert words is None or words in session.warnings[0]


@pytest.mark.parametrize(('kind', 'words'), [
    ('pose', 'the poses cannot be in one robot base'),
    ('profile', 'the profiles cannot be of one sensor')])
def test_two_frames_are_told_apart_by_topic(kind: str, words: str) -> None:
    assert words in str(TwoFramesError(kind, 'a', 'b'))


@pytest.mark.parametrize('kind', ['pose', 'profile'])
def test_two_frames_on_one_topic_are_refused(kind: str) -> None:
    session = played(stops((0, 1)), profiles(0, 1), finish=False)
    stranger = pose(1.5, frame='map') if kind == 'pose' else profile(1.5, frame='other')
    add(session, stranger)
    with pytest.raises(TwoFramesError, match=f'{kind}.*two frames'):
        session.finish()
    assert 'map' in session.warnings[0] or 'other' in session.warnings[0]


def test_no_poses_no_stops_and_millimetres_are_told_apart() -> None:
    with pytest.raises(NoPosesError):
        played([], profiles(0, 3)).require_stations()
    moving = [pose(t, x=0.2 * t) for t in np.arange(0, 3, 0.02)]
    with pytest.raises(NoStationsError, match='150 poses'):
        played(moving, profiles(0, 3)).require_stations()
    metres_per_thousand = [replace(p, translation=p.translation * 1e3) for p in moving]
    with pytest.raises(PositionUnitError, match='mm'):
        played(metres_per_thousand, profiles(0, 3)).require_stations()
    sparse = [pose(t, x=0.1 * (t // 10)) for t in range(60)]
    with pytest.raises(SparsePosesError, match='only every 1 s, .*raise sampling.max_pose_gap'):
        played(sparse, profiles(0, 60)).require_stations()
    wide = with_values(CONFIG, {'sampling.max_pose_gap': 2.0}, 'test')
    assert len(played(sparse, profiles(0, 60), wide).samples) == 6
    played(stops((0, 1)), []).require_stations()


def test_values_that_are_not_finite_end_in_no_sample() -> None:
    poses = stops((0, 1))
    poses[20] = replace(poses[20], translation=np.array([np.nan, 0.2, 0.3]))
    session = played(poses, profiles(0, 1))
    for sample in session.samples:
        assert np.isfinite(sample.T_base_flange).all()


# -- by hand


def test_a_sample_is_taken_of_the_station_that_the_robot_stands_in() -> None:
    session = played(stops((0, 1), (2, 3)), profiles(0, 3), MANUAL, finish=False)
    assert session.samples == ()
    sample = session.take_sample()
    assert session.samples == (sample,) and sample.T_base_flange[0, 3] == pytest.approx(0.1)
    assert session.finish() == [] and len(session.samples) == 1


def test_taking_twice_at_one_stop_keeps_one_sample() -> None:
    session = played(stops((0, 1)), profiles(0, 1), MANUAL, finish=False)
    first = session.take_sample()
    for p in [pose(1.02 + 0.02 * i) for i in range(20)]:
        session.add_pose(p)
    for p in profiles(1.0, 1.4):
        session.add_profile(p)
    second = session.take_sample()
    assert session.samples == (second,) and second.profiles > first.profiles


def test_however_often_one_spot_is_taken_it_is_one_sample() -> None:
    session = Session(MANUAL)
    length = 3 * MAX_STATION // NS
    for item in sorted([*stops((0, length)), *profiles(0, length, rate=2.0)],
                       key=lambda item: item.stamp):
        add(session, item)
        if isinstance(item, Profile) and item.stamp > START + NS:
            session.take_sample()
        assert len(session.samples) <= 1


def test_a_sample_is_kept_when_taking_it_again_fails() -> None:
    session = played(stops((0, 1)), profiles(0, 1), MANUAL, finish=False)
    sample = session.take_sample()
    for p in [pose(1.02 + 0.02 * i) for i in range(200)]:
        session.add_pose(p)
    for p in profiles(1.0, 4.9, points=BAD):
        session.add_profile(p)
    with pytest.raises(FeatureError):
        session.take_sample()
    assert session.samples == (sample,)


def test_a_sample_by_hand_takes_none_from_the_stop_before() -> None:
    session = Session(CONFIG)  # one profile a stop: the first stop waits for that of the second
    for start in (0, 20):
        for t in np.arange(start, start + 1, 0.02):
            add(session, pose(t, x=0.01 * start))
        add(session, profile(start + 0.5))
        session.collect()
    session.take_sample()
    session.finish()
    assert sorted(round(float(s.T_base_flange[0, 3]), 6) for s in session.samples) == [0.0, 0.2]


def test_a_sample_by_hand_is_not_taken_again_by_itself() -> None:
    session = played(stops((0, 1)), profiles(0, 1), finish=False)
    session.take_sample()
    for item in sorted([*stops((0, 1), (2, 3))[52:], *profiles(1.02, 3)],
                       key=lambda item: item.stamp):
        add(session, item)
        session.collect()
    session.finish()
    assert [round(float(s.T_base_flange[0, 3]), 6) for s in session.samples] == [0.0, 0.1]


def test_why_no_sample_can_be_taken_is_told() -> None:
    session = Session(MANUAL)
    with pytest.raises(NoPosesError):
        session.take_sample()
    session = played([pose(t, x=t) for t in np.arange(0, 1, 0.02)], profiles(0, 1), MANUAL)
    with pytest.raises(MovingError, match='0.5 s'):
        session.take_sample()
    with pytest.raises(NoProfilesError):
        played(stops((0, 1)), [], MANUAL).take_sample()
    with pytest.raises(FeatureError, match='edge'):
        played(stops((0, 1)), profiles(0, 1, points=BAD), MANUAL).take_sample()


def test_the_last_sample_can_be_removed() -> None:
    session = played(stops((0, 1), (2, 3)), profiles(0, 3))
    first, second = session.samples
    assert session.remove_last().result is second and session.samples == (first,)
    assert session.remove_last().result is first
    with pytest.raises(NothingToRemoveError):
        session.remove_last()


def test_stops_whose_samples_were_removed_are_stops() -> None:
    session = played(stops((0, 1)), profiles(0, 1))
    session.remove_last()
    session.require_stations()


def test_clearing_forgets_everything_also_the_frames_and_the_time() -> None:
    session = played(stops((0, 1)), [*profiles(0, 1), profile(1.5, frame='x')], finish=False)
    session.clear()
    assert session.samples == session.rejects == session.warnings == ()
    assert session.frame_id == ''
    again = sorted([*stops((0, 1)), *(replace(p, frame_id='x') for p in profiles(0, 1))],
                   key=lambda item: item.stamp)
    for item in again:
        add(session, item)
    assert len(session.finish()) == 1 and session.frame_id == 'x'


def test_automatic_samples_can_be_switched_on_and_off() -> None:
    session = Session(MANUAL)
    for item in sorted([*stops((0, 1), (2, 3)), *profiles(0, 3)], key=lambda item: item.stamp):
        if item.stamp > START + round(1.5 * NS):
            session.configure(CONFIG)
        add(session, item)
    session.finish()
    assert [round(float(s.T_base_flange[0, 3]), 6) for s in session.samples] == [0.1]


def test_a_stop_near_an_earlier_one_brings_nothing_new() -> None:
    config, near = Config(), stops((0, 1), (2, 3))
    poses = [replace(p, translation=p.translation * [0.06, 1, 1]) for p in near]  # 6 mm apart
    session = played(poses, profiles(0, 3), config)
    reject, = session.rejects
    assert reject.reason == '6 mm and 0.0 degrees from sample 1: it brings nothing new'
    left_out = with_values(config, {'samples.exclude': [1]}, 'test')
    assert len(played(poses, profiles(0, 3), left_out).samples) == 1, 'of the second stop'
    turned = [replace(p, quaternion=pose(0, turn=0.1 * (p.stamp > START + NS)).quaternion)
              for p in poses]
    assert len(played(turned, profiles(0, 3), config).samples) == 2
    manual = with_values(config, {'sampling.mode': 'manual'}, 'test')
    by_hand = played([p for p in poses if p.stamp <= START + NS], profiles(0, 1), manual,
                     finish=False)
    by_hand.take_sample()
    for item in sorted([*poses[51:], *profiles(1.01, 3)], key=lambda item: item.stamp):
        add(by_hand, item)
    with pytest.raises(NothingNewError, match='6 mm .* from sample 1: .* move on'):
        by_hand.take_sample()


def test_a_moving_robot_is_told_its_speed() -> None:
    creeping = [pose(t, x=4e-3 * t) for t in np.arange(0, 2, 0.02)]
    with pytest.raises(MovingError, match=r'it moves by 4\.0 mm/s and 0\.0 degrees/s'):
        played(creeping, profiles(0, 2), MANUAL, finish=False).take_sample()


def test_silent_poses_are_told() -> None:
    session = played(stops((0, 1)), profiles(0, 1.32), MANUAL, finish=False)
    with pytest.raises(SilentPosesError, match=r'silent for 0\.3 s'):
        session.take_sample()


@pytest.mark.parametrize(('cut', 'words'), [
    (0.3e-3, 'the border of the field of view'), (0.9e-3, '0.9 mm from the end of the view'),
    (2e-3, '')])
def test_an_edge_at_the_end_of_the_view_is_told(cut: float, words: str) -> None:
    points = with_lost(drawn(step_up_to(0.002)))
    points = points[~(points[:, 0] > 0.002 + cut)].copy()
    points[0] = np.nan  # a driver that sends the columns without a return too
    config = with_values(CONFIG, {'sampling.min_points': 5}, 'test')
    session = played(stops((0, 1)), profiles(0, 1, points=points), config)
    reasons = [reject.reason for reject in session.rejects]
    assert (words in reasons[0]) if words else not reasons, reasons


# -- interpolation


def random_walk(seed: int, count: int = 6) -> list[TimedPose]:
    rng = np.random.default_rng(seed)
    stamps = START + np.cumsum(rng.integers(1, 50, count)) * MS
    quaternions = rng.normal(size=4) + 0.3 * rng.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    return [TimedPose(int(s), rng.normal(size=3), q) for s, q in
            zip(stamps, quaternions, strict=True)]


def slerp(a: Array, b: Array, share: float) -> Array:
    """Return the great circle from quaternion a to b (Shoemake 1985), the short way."""
    b = b if a @ b >= 0 else -b
    angle = np.arccos(min(1.0, float(a @ b)))
    if angle < 1e-9:
        return a
    return (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle)


@given(st.integers(0, 1000), st.floats(0, 1))
def test_poses_between_are_linear_and_on_the_great_circle(seed: int, at: float) -> None:
    poses = random_walk(seed)
    stamp = poses[0].stamp + round(at * (poses[-1].stamp - poses[0].stamp))
    k = min(max(sum(p.stamp <= stamp for p in poses) - 1, 0), len(poses) - 2)
    a, b = poses[k], poses[k + 1]
    share = (stamp - a.stamp) / (b.stamp - a.stamp)
    translation = (1 - share) * a.translation + share * b.translation
    expected = se3.from_quaternion(translation, slerp(a.quaternion, b.quaternion, share))
    assert np.allclose(interpolate(poses, [stamp])[0], expected, atol=1e-6)


@pytest.mark.parametrize('beyond', [-1, 1])
def test_nothing_is_extrapolated(beyond: int) -> None:
    poses = random_walk(1)
    stamp = poses[0].stamp - 1 if beyond < 0 else poses[-1].stamp + 1
    with pytest.raises(ValueError, match='outside'):
        interpolate(poses, [poses[1].stamp, stamp])


def test_stamps_of_this_century_keep_their_nanoseconds() -> None:
    a, b = pose(0.0), pose(1.0, x=1.0)
    at = [a.stamp + 1, a.stamp + 500_000_001]
    assert np.allclose(interpolate([a, b], at)[:, 0, 3], [1e-9, 0.500000001], atol=1e-15, rtol=0)
