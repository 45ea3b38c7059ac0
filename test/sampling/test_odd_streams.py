"""Streams that are not as they should be: dropped, told or refused, whatever it is."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.config import with_values
from handeye_ros.sampling.errors import (
    NoPosesError,
    NoStationsError,
    PositionUnitError,
    SilentPosesError,
    SparsePosesError,
    TwoFramesError,
)
import numpy as np
from profiles import drawn, step_up_to, with_lost
import pytest
from streams import add, BAD, CONFIG, MANUAL, played, pose, profile, profiles, stops


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
