"""Face lines and edge points of drawn profiles, and of simulated ones against their truth."""
from __future__ import annotations

from collections.abc import Callable
import warnings

from cells import config as settings_of
from cells import recorded
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, EdgePoint, FaceLine, Feature
from handeye_ros.profiles.errors import FeatureError
from handeye_ros.profiles.faces import face_features
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.station_features import combine
from handeye_ros.simulate import SCENARIOS
from hypothesis import given
import numpy as np
from profiles import (
    any_points,
    COLUMNS,
    face,
    gap_up_to,
    NOISE,
    PITCH,
    roof,
    step_up_to,
    with_lost,
    X,
)
from profiles import (
    drawn as drawn_whole,
)
import pytest

CONFIG = Config()
TOWARDS = with_values(CONFIG, {'profile.range_sign': -1}, 'test')


def drawn(height: Callable[[Array], Array], seed: int = 0) -> Array:
    return with_lost(drawn_whole(height, seed))


def found(points: Array, config: Config = CONFIG) -> tuple[FaceLine, list[EdgePoint]]:
    """Return the face line and the edges of a profile, left to right."""
    line, *edges = face_features(points, config)
    assert isinstance(line, FaceLine)
    assert all(isinstance(edge, EdgePoint) for edge in edges)
    return line, sorted(edges, key=lambda edge: edge.point[0])


def assert_edge(edge: EdgePoint, x: float, z: float, side: int, kind: str) -> None:
    """Check an edge at x, z whose face lies on the other side of it than side says."""
    along = edge.direction
    assert edge.kind == kind and np.sign(along[0]) == side
    assert np.linalg.norm(along) == pytest.approx(1)
    away = np.array([x, z]) - edge.point
    assert abs(away @ along) < 4 * edge.std and abs(away @ along) < 2 * PITCH
    assert abs(away @ [-along[1], along[0]]) < 5 * edge.std_across


EDGES = [(step_up_to, 'step'), (gap_up_to, 'gap'), (roof, 'roof')]


@pytest.mark.parametrize(('shape', 'kind'), EDGES, ids=[kind for _, kind in EDGES])
@pytest.mark.parametrize('tilt', [-0.4, 0.0, 0.3])
@pytest.mark.parametrize('mirrored', [False, True])
def test_an_edge_is_found_where_it_is(shape: Callable[..., Callable[[Array], Array]], kind: str,
                                      tilt: float, mirrored: bool) -> None:
    # of the two faces of a roof the larger one is taken
    for seed, edge in enumerate(np.linspace(-0.008, -0.002 if kind == 'roof' else 0.008, 9)):
        tilt_of_face = tilt if kind != 'roof' else abs(tilt)
        points = drawn(shape(edge, tilt_of_face), seed)
        if mirrored:
            points = points * [-1, 1]
        side = 1 if mirrored else -1
        line, (only,) = found(points)
        assert_edge(only, -side * edge, face(edge, tilt_of_face), side, kind)
        assert abs(line.direction @ only.direction) == pytest.approx(1)
        assert (only.point - line.centre) @ only.direction > 0, 'the edge leads out of the face'


def test_a_roof_edge_is_far_better_than_a_column() -> None:
    errors = [found(drawn(roof(0.003), seed))[1][0].point[0] - 0.003 for seed in range(30)]
    stated = found(drawn(roof(0.003)))[1][0].std
    assert np.std(errors) < PITCH / 12 ** 0.5
    assert np.std(errors) == pytest.approx(stated, rel=0.4)


@pytest.mark.parametrize('tilt', [-0.5, 0.0, 0.3])
def test_the_face_line_is_as_certain_as_it_says(tilt: float) -> None:
    offsets, turns = [], []
    for seed in range(60):
        line, _ = found(drawn(gap_up_to(-0.005, tilt), seed))
        normal = np.array([-np.sin(tilt), np.cos(tilt)])
        offsets.append(((line.centre - [0, face(0.0, tilt)]) @ normal) / line.std)
        turns.append(line.direction @ normal * line.spread / line.std)
    assert np.std(offsets) == pytest.approx(1, abs=0.35)
    assert np.std(turns) == pytest.approx(1, abs=0.35)
    assert abs(np.corrcoef(offsets, turns)[0, 1]) < 0.4


@pytest.mark.parametrize('tilt', [-0.5, 0.0, 0.3])
def test_the_normal_points_of_a_face_are_as_certain_as_they_say(tilt: float) -> None:
    normal = np.array([-np.sin(tilt), np.cos(tilt)])
    single, together = [], []
    for seed in range(60):
        line, _ = found(drawn(gap_up_to(-0.005, tilt), seed))
        single.append((line.points - [0, face(0.0, tilt)]) @ normal / line.points_std)
        ends = (line.points[[0, -1]] - line.centre) @ line.direction / line.spread
        assert np.allclose(np.abs(ends), 5 / 6 * 3 ** 0.5, rtol=0.05), 'shares of one length'
    for seed in range(20):
        line, _ = combine(many(gap_up_to(-0.005, tilt), 8, seed))
        together.append((line.points - [0, face(0.0, tilt)]) @ normal / line.points_std)
    assert np.shape(single) == (60, 6) and np.shape(together) == (20, 6)
    assert np.std(single) == pytest.approx(1, abs=0.2)
    assert np.std(together) == pytest.approx(1, abs=0.3)


def test_both_edges_of_a_profile_are_found() -> None:
    def height(x: Array) -> Array:
        return np.where(np.abs(x) < 0.008, face(x), np.nan)
    line, (left, right) = found(drawn(height))
    assert_edge(left, -0.008, face(-0.008), -1, 'gap')
    assert_edge(right, 0.008, face(0.008), 1, 'gap')
    assert line.spread == pytest.approx(0.016 / 12 ** 0.5 / np.cos(0.1), rel=0.02)


def test_a_step_on_one_side_and_nothing_on_the_other_are_both_edges() -> None:
    def height(x: Array) -> Array:
        return np.where(x > 0.01, np.nan, np.where(x > -0.006, face(x), face(x) + 0.01))
    _, (left, right) = found(drawn(height))
    assert_edge(left, -0.006, face(-0.006), -1, 'step')
    assert_edge(right, 0.01, face(0.01), 1, 'gap')


@pytest.mark.parametrize('config', [CONFIG, TOWARDS], ids=['away', 'towards'])
def test_of_a_step_the_side_nearer_to_the_sensor_is_the_face(config: Config) -> None:
    sign = config.profile.range_sign
    points = drawn(step_up_to(0.002, drop=sign * 0.01))
    line, (edge,) = found(points, config)
    assert_edge(edge, 0.002, face(0.002), -1, 'step')
    assert line.centre[0] > 0.002
    line, (edge,) = found(drawn(step_up_to(0.002, drop=-sign * 0.01)), config)
    assert_edge(edge, 0.002, face(0.002) - sign * 0.01, 1, 'step')
    assert line.centre[0] < 0.002


def test_the_whole_field_of_view_is_no_face_with_an_edge() -> None:
    with pytest.raises(FeatureError, match='no edge'):
        face_features(drawn(face), CONFIG)


def test_lost_points_inside_the_face_are_no_edge() -> None:
    points = drawn(gap_up_to(-0.012))
    points[300:340, 1] = np.nan
    points[400:403, 1] = np.inf
    points[::9] = np.nan
    _, (edge,) = found(points)
    assert edge.point[0] == pytest.approx(-0.012, abs=3 * PITCH)


def test_two_lost_points_at_the_border_are_no_edge() -> None:
    points = drawn(face)
    points[:2], points[-1] = np.nan, np.nan
    with pytest.raises(FeatureError, match='border'):
        face_features(points, CONFIG)


def test_a_few_lost_points_before_a_step_do_not_hide_it() -> None:
    points = drawn(step_up_to(0.0))
    middle = COLUMNS // 2
    points[middle - 4:middle + 1, 1] = np.nan
    _, (edge,) = found(points)
    assert_edge(edge, 0.0, face(0.0), -1, 'shadow')


def test_mixed_points_widen_the_edge_instead_of_moving_it() -> None:
    clean = found(drawn(step_up_to(1e-5)))[1][0]
    points = drawn(step_up_to(1e-5))
    at = int(np.flatnonzero(X > 1e-5)[0]) - 1
    points[at, 1] = face(X[at]) + 0.004  # of a drop of 10 mm
    mixed = found(points)[1][0]
    assert mixed.std > 1.5 * clean.std
    assert abs(mixed.point[0] - clean.point[0]) < PITCH


def test_outliers_and_speckle_do_not_move_an_edge() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points = drawn(step_up_to(0.0021), seed)
        wrong = rng.random(COLUMNS) < 0.05
        points[wrong, 1] += rng.uniform(-5e-3, 5e-3, wrong.sum())
        points[:, 1] += np.convolve(rng.normal(size=COLUMNS + 3), np.ones(4) / 2, 'valid') * NOISE
        edges = found(points)[1]
        nearest = min(abs(edge.point[0] - 0.0021) for edge in edges)
        assert len(edges) == 1 and nearest < 6 * PITCH


def test_a_nearer_object_beside_the_face_does_not_make_an_edge() -> None:
    # what stands in front hides where the face ends, if it ends there at all
    def height(x: Array) -> Array:
        return np.where(x > 0.012, face(x) - 0.008, np.where(x > -0.004, face(x), np.nan))
    points = drawn(height)
    line, edges = found(points)
    for edge in edges:
        assert np.abs(edge.point[0] - 0.012) < 3 * PITCH and edge.direction[0] < 0 or (
            np.abs(edge.point[0] + 0.004) < 3 * PITCH)
    assert all(not (abs(edge.point[0] - 0.012) < 1e-3 and edge.direction[0] > 0)
               for edge in edges)


def test_columns_may_run_backwards() -> None:
    for shape, kind in EDGES:
        points = drawn(shape(0.003))
        (line, (edge,)), (line_back, (edge_back,)) = found(points), found(points[::-1])
        assert np.allclose(edge.point, edge_back.point) and edge.kind == edge_back.kind == kind
        assert np.allclose(edge.direction, edge_back.direction)
        assert np.allclose(line.centre, line_back.centre)


def test_a_profile_in_mirror_has_mirrored_features() -> None:
    for shape, _ in EDGES:
        points = drawn(shape(0.003))
        (line, (edge,)), (line_m, (edge_m,)) = found(points), found(points * [-1, 1])
        assert np.allclose(edge.point * [-1, 1], edge_m.point)
        assert np.allclose(edge.direction * [-1, 1], edge_m.direction)
        assert np.allclose(line.centre * [-1, 1], line_m.centre)
        assert (line.std, line.spread) == pytest.approx((line_m.std, line_m.spread))


def test_a_driver_that_leaves_lost_points_out_gives_open_ends() -> None:
    points = drawn(gap_up_to(0.0))
    points = points[np.isfinite(points).all(axis=1)]
    _, edges = found(points)
    assert [edge.kind for edge in edges] == ['open', 'open'], 'one of them is the border'
    assert edges[0].point[0] == pytest.approx(0, abs=PITCH)


@pytest.mark.parametrize('points', [
    np.empty((0, 2)), np.full((50, 2), np.nan), np.zeros((50, 2)), np.full((50, 2), np.inf),
    np.full((50, 2), 0.17), drawn(face)[:10],
    np.random.default_rng(0).uniform(0.15, 0.2, (640, 2))])
def test_what_shows_no_face_is_refused_with_a_reason(points: Array) -> None:
    with pytest.raises(FeatureError, match='face'):
        face_features(points, CONFIG)


@given(any_points())
def test_any_array_gives_finite_features_or_a_reason(points: Array) -> None:
    before = points.copy()
    for config in (CONFIG, TOWARDS):
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            try:
                features = face_features(points, config)
            except FeatureError as error:
                assert str(error)
                continue
        assert len(features) >= 2
        assert_finite(features)
    assert np.array_equal(points, before, equal_nan=True)


def assert_finite(features: tuple[Feature, ...]) -> None:
    for f in features:
        values = [f.centre, f.direction, f.spread, f.std] if isinstance(f, FaceLine) else [
            f.point, f.direction, f.std, f.std_across]
        assert all(np.isfinite(value).all() for value in values)
        assert np.linalg.norm(f.direction) == pytest.approx(1) and f.std >= 0


# -- the profiles of a station together


def many(height: Callable[[Array], Array], count: int = 15, seed: int = 0
         ) -> list[tuple[Feature, ...]]:
    return [face_features(drawn(height, seed * 100 + i), CONFIG) for i in range(count)]


def test_one_profile_is_what_it_is() -> None:
    one = many(step_up_to(0.002), 1)
    assert combine(one) == one[0]


def test_more_profiles_make_the_face_line_better() -> None:
    line, edge = combine(many(step_up_to(0.002), 16))
    single, _ = many(step_up_to(0.002), 1)[0]
    assert line.std == pytest.approx(single.std / 4, rel=0.5)
    assert abs(edge.point[0] - 0.002) < 4 * edge.std
    errors = [combine(many(step_up_to(0.002), 8, s))[0] for s in range(20)]
    offsets = [(f.centre[1] - face(f.centre[0])) * np.cos(0.1) / f.std for f in errors]
    assert np.std(offsets) == pytest.approx(1, abs=0.4)


def test_the_rounding_to_a_column_does_not_average_out() -> None:
    edge = combine(many(step_up_to(0.002), 30))[1]
    assert isinstance(edge, EdgePoint) and edge.std > 0.9 * PITCH / 12 ** 0.5


def test_what_scatters_between_profiles_is_less_certain() -> None:
    rng = np.random.default_rng(1)
    calm = combine(many(step_up_to(0.002)))
    moved = [face_features(drawn(step_up_to(0.002)) + [s, 0.05 * s], CONFIG)
             for s in rng.normal(0, 4e-4, 15)]
    shaken = combine(moved)
    assert shaken[1].std > 3 * calm[1].std and shaken[0].std > 2 * calm[0].std


@pytest.mark.parametrize('wrong', [
    step_up_to(-0.007), lambda x: step_up_to(0.002)(x) + 0.003,
    lambda x: step_up_to(0.002, tilt=0.25)(x)])
def test_a_profile_that_disagrees_is_outvoted(wrong: Callable[[Array], Array]) -> None:
    right = many(step_up_to(0.002), 11)
    line, edge = combine(right)
    line_w, edge_w = combine([*right, *many(wrong, 2, 7)])
    assert np.linalg.norm(edge_w.point - edge.point) < edge.std
    for x in (0.005, 0.015):
        heights = [f.centre[1] + f.direction[1] / f.direction[0] * (x - f.centre[0])
                   for f in (line, line_w)]
        assert abs(heights[0] - heights[1]) < 2e-5


def test_an_edge_that_few_profiles_show_is_left_out() -> None:
    def both(x: Array) -> Array:
        return np.where(x > 0.012, np.nan, step_up_to(0.002)(x))
    features = combine([*many(step_up_to(0.002), 8), *many(both, 3, 1)])
    assert [f.direction[0] < 0 for f in features if isinstance(f, EdgePoint)] == [True]
    features = combine([*many(step_up_to(0.002), 3), *many(both, 8, 1)])
    assert len([f for f in features if isinstance(f, EdgePoint)]) == 2


@pytest.mark.parametrize('apart', [0.0007, 0.0019, 0.004])
def test_a_station_that_was_bumped_is_refused_with_a_reason(apart: float) -> None:
    for count in (6, 7):
        halves = [*many(step_up_to(0.002), 7),
                  *many(lambda x: step_up_to(0.002)(x) + apart, count, 1)]
        with pytest.raises(FeatureError, match=f'how high the face is: .* {apart * 1e3:.1f}'):
            combine(halves)
        halves = [*many(step_up_to(0.002), 7), *many(step_up_to(0.002 + apart), count, 1)]
        with pytest.raises(FeatureError, match='where the edge is'):
            combine(halves)


@pytest.mark.parametrize('count', [1, 8])
def test_frozen_speckle_of_a_face_does_not_average_out(count: int) -> None:
    # alike over five columns, the same in every profile while the robot stands
    offsets, shares = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        frozen = np.convolve(rng.normal(size=COLUMNS + 4), np.ones(5) / 5 ** 0.5, 'valid') * NOISE
        points = [drawn_whole(gap_up_to(-0.005), 100 * seed + k, NOISE / 6) + np.column_stack(
            [np.zeros(COLUMNS), frozen]) for k in range(count)]
        found = [face_features(with_lost(p), CONFIG) for p in points]
        line = combine(found)[0]
        normal = np.array([-np.sin(0.1), np.cos(0.1)])
        offsets.append((line.centre - [0, face(0.0)]) @ normal / line.std)
        shares.append((line.points - [0, face(0.0)]) @ normal / line.points_std)
    assert np.std(offsets) == pytest.approx(1, abs=0.35)
    assert np.std(shares) == pytest.approx(1, abs=0.25)


def test_a_bent_end_is_not_in_the_line() -> None:
    # 120 points of a face, 14 of which bend away within the tolerance of the line
    def height(x: Array) -> Array:
        return np.where(x > -0.0125, face(x, 0.0) + np.maximum(-0.01165 - x, 0) ** 2 / 0.008,
                        np.nan)
    errors = []
    for seed in range(20):
        points = drawn(height, seed)[:240]
        line, _ = found(np.concatenate([points, np.full((5, 2), np.nan)]))
        errors.append((line.points[:, 1] - 0.17) / line.points_std)
    assert np.abs(np.mean(errors, axis=0)).max() < 1.5


# -- against the truth of a simulated recording


@pytest.mark.parametrize('name', ['plate', 'plate_in_air', 'plate_clutter', 'plate_resampled',
                                  'plate_reflections', 'plate_omit', 'plate_x_reversed'])
def test_simulated_edges_are_as_near_to_the_truth_as_they_say(name: str) -> None:
    along, across = [], []
    for seed in range(2):
        recording = recorded(name, seed)
        session = Session(recording.config)
        for pose in recording.poses:
            session.add_pose(pose)
        for profile in recording.profiles:
            session.add_profile(profile)
        session.finish()
        mirror = np.array([-1.0 if name == 'plate_x_reversed' else 1.0, 1.0])
        for station in recording.truth.stations:
            sample, = (s for s in session.samples if station.start <= s.stamp <= station.end)
            edges = [f for f in sample.features if isinstance(f, EdgePoint)]
            away = min((station.point * mirror - e.point for e in edges), key=np.linalg.norm)
            edge = min(edges, key=lambda e: np.linalg.norm(station.point * mirror - e.point))
            normal = np.array([-edge.direction[1], edge.direction[0]])
            along.append(away @ edge.direction / edge.std)
            across.append(away @ normal / edge.std_across)
    z = np.abs([along, across])
    assert (np.median(z, axis=1) < 1.4).all()
    # where half of the profiles of a station show a reflection, the station may be wrong
    some = z[:, (z < 6).all(axis=0)]
    assert some.shape[1] >= len(along) - 2
    assert ((some ** 2).mean(axis=1) ** 0.5 < 1.7).all() and ((some ** 2).mean(axis=1) > 0.3).all()


def test_the_settings_of_every_plate_scenario_fit_its_profiles() -> None:
    for name in ('plate_z_up', 'plate_y_along_line', 'plate_inf'):
        recording = recorded(name, 0, rate=3.0, columns=640)
        config = settings_of(SCENARIOS[name])
        found_in = 0
        for profile in recording.profiles:
            try:
                found_in += bool(face_features(profile.points, config))
            except FeatureError:
                continue
        assert found_in > 0.4 * len(recording.profiles)
