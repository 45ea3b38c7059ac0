# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A seam in a cloud: edges, centre line and frames against the truth; refusals in words."""
from __future__ import annotations

from dataclasses import dataclass, replace

from calibrations import calibration_at
from command import assert_refused, handeye, succeeds
from handeye_ros import se3
from handeye_ros.bags import writer
from handeye_ros.data import Array, Profile, TimedPose
from handeye_ros.errors import DataError
from handeye_ros.results.calibration_file import write_calibration
from handeye_ros.scanning.cloud import write_cloud
from handeye_ros.scanning.curves import spline
from handeye_ros.scanning.seam import find_seam, sentences, tool_frames
from handeye_ros.simulate.artefacts import preform_cloud, PreformCloud
import numpy as np
import pytest
from quick import long_run
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_typestore, Stores
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
import yaml

# -- joints as a laser profiler sees them: a section swept along y, with shadows and noise. The
# laser source stands above the seam and leans about it; each ray meets the first surface on its
# way. Not the simulator of the package: what finds seams is not tried on what it was made with.

FAR = 60.0  # mm: where surfaces end that the sensor sees no end of


@dataclass(frozen=True)
class Joint:
    """
    A cross-section and how it is scanned; millimetres and degrees.

    segments: lines (u, h, u, h) of the section; line: (u, h) of the true seam; toward: the angle
    of the true approach from straight down. bend: radius of the seam in plan, 0: straight.
    below: what lies there beyond the ends of the part, nan: nothing. missing: length in the middle
    that was not scanned.
    """

    segments: tuple[tuple[float, float, float, float], ...]
    line: tuple[float, float]
    toward: float = 0.0
    lean: float = 0.0
    length: float = 120.0
    bend: float = 0.0
    spatter: int = 0
    noise: float = 0.03
    below: float = float('nan')
    missing: float = 0.0


def butt(gap: float, depth: float, half: float = FAR, **more) -> Joint:
    """Return two plates on a backing, seen down to it."""
    e, h = gap / 2, half
    sides = [(-h, 0, -e, 0), (e, 0, h, 0)]
    sides += [(s * w, 0, s * w, -depth) for s in (-1, 1) for w in ({e, h} - {FAR})]
    return Joint((*sides, (-80, -depth, 80, -depth)), (0.0, 0.0), **more)


def lap(height: float, **more) -> Joint:
    """Return a sheet that lies on another."""
    return Joint(((-FAR, height, 0, height), (0, height, 0, 0), (0, 0, FAR, 0)),
                 (0.0, height / 2), **more)


def vee(thick: float, gap: float, angle: float = 30.0, land: float = 1.0, **more) -> Joint:
    """Return a V with a root gap on a backing; the line is that of the root."""
    e = gap / 2
    top = e + (thick - land) * np.tan(np.radians(angle))
    half = ((top, 0, FAR, 0), (e, land - thick, top, 0), (e, -thick, e, land - thick))
    mirrored = tuple((-a, b, -c, d) for a, b, c, d in half)
    return Joint((*half, *mirrored, (-80, -thick, 80, -thick)), (0.0, land - thick), **more)


def tee(height: float, web: float = 8.0, toward: float = 45.0, **more) -> Joint:
    """Return a web that stands on a plate, its right side seen; the line is that of the root."""
    return Joint(((-web, height, 0, height), (0, height, 0, 0), (-FAR, 0, FAR, 0),
                  (-web, 0, -web, height)), (0.0, 0.0), toward=toward, **more)


def corner(angle: float, **more) -> Joint:
    """Return two plates that meet at an angle, open upwards; the line is that of the root."""
    u, h = FAR * np.sin(np.radians(angle / 2)), FAR * np.cos(np.radians(angle / 2))
    return Joint(((-u, h, 0, 0), (0, 0, u, h)), (0.0, 0.0), **more)


def scanned(joint: Joint, rng: np.random.Generator) -> PreformCloud:
    """Return what a scan of a joint shows."""
    rows, y = [], np.arange(-joint.length / 2 - 10, joint.length / 2 + 10, 0.4)
    balls = np.column_stack([rng.uniform(-3, 3, joint.spatter),
                             rng.uniform(-0.48, 0.48, joint.spatter) * joint.length,
                             rng.uniform(0.5, 1.5, joint.spatter)])
    for at in y:
        shift = at ** 2 / (2 * joint.bend) if joint.bend else 0.0
        inside = joint.missing / 2 <= abs(at) <= joint.length / 2
        segments = joint.segments if inside else (
            ((-80, joint.below, 80, joint.below),) if np.isfinite(joint.below) else ())
        if not segments:
            continue
        u, h = _rays(joint, np.array(segments, dtype=float), balls[inside * np.abs(
            balls[:, 1] - at) < balls[:, 2]] if inside else balls[:0], at, rng)
        off = rng.normal(size=3) * 0.02  # of the robot
        rows.append(np.column_stack([u + shift + off[0], np.full(len(u), at) + off[1],
                                     h + off[2]]))
    T = se3.transform(Rotation.from_euler('xyz', rng.uniform([-0.2, -0.2, -3], [0.2, 0.2, 3])
                                          ).as_matrix(), np.array([0.8, 0.1, 0.2]))
    along = np.linspace(-0.5, 0.5, 2001) * joint.length
    line = np.column_stack([joint.line[0] + (along ** 2 / (2 * joint.bend) if joint.bend else 0
                                             * along), along, np.full(2001, joint.line[1])])
    a = np.radians(joint.toward)
    normals = np.tile([np.sin(a), 0.0, np.cos(a)], (2001, 1))
    return PreformCloud(se3.apply(T, np.concatenate(rows) * 1e-3), se3.apply(T, line * 1e-3),
                        normals @ T[:3, :3].T)


def _rays(joint: Joint, segments: Array, balls: Array, at: float, rng: np.random.Generator
          ) -> tuple[Array, Array]:
    """Return where the rays of one profile end (n,), (n,)."""
    a, far = np.radians(joint.lean), 200.0
    source = far * np.array([np.sin(a), np.cos(a)])
    slope = np.linspace(-30.0, 30.0, 640) / far
    way = np.column_stack([slope * np.cos(a) - np.sin(a), -slope * np.sin(a) - np.cos(a)])
    first, step = segments[:, :2], segments[:, 2:] - segments[:, :2]
    cross = way[:, None, 0] * step[:, 1] - way[:, None, 1] * step[:, 0]
    offset = first - source
    with np.errstate(divide='ignore', invalid='ignore'):
        t = (offset[:, 0] * step[:, 1] - offset[:, 1] * step[:, 0]) / cross
        s = (offset[:, 0] * way[:, None, 1] - offset[:, 1] * way[:, None, 0]) / cross
    steep = np.abs(cross) < np.cos(np.radians(80)) * np.linalg.norm(step, axis=1) * np.linalg.norm(
        way, axis=1)[:, None]
    t = np.where((s >= 0) & (s <= 1) & (t > 0), t, np.inf)
    best = np.argmin(t, axis=1)
    t = np.where(steep[np.arange(len(t)), best], np.inf, t[np.arange(len(t)), best])
    for u, y, r in balls:
        centre = np.array([u, 0.0]) - source
        squared = (way ** 2).sum(axis=1)
        b = way @ centre
        root = b ** 2 - squared * (centre @ centre - (r ** 2 - (y - at) ** 2))
        hit = root > 0
        t[hit] = np.minimum(t[hit], (b[hit] - np.sqrt(root[hit])) / squared[hit])
    seen = np.isfinite(t)
    ends = source + t[seen, None] * way[seen]
    unit = way[seen] / np.linalg.norm(way[seen], axis=1)[:, None]
    ends = ends + joint.noise * rng.normal(size=(len(ends), 1)) * unit
    return ends[:, 0], ends[:, 1]


STAIRS = Joint(((-FAR, 10, -12, 10), (-12, 10, -12, 5), (-12, 5, 12, 5), (12, 5, 12, 0),
                (12, 0, FAR, 0)), (0.0, 0.0))
JOINTS = {
    **{f'butt 3, backing {d}': butt(3, d) for d in (1, 2, 5, 10)},
    'butt 3, no backing': butt(3, float('nan')),
    'butt 3 on a table, seen all round': butt(3, 5, half=20, below=-5),
    'butt 2, lean 15, bent': butt(2, 5, lean=15, bend=400),
    **{f'lap 5, lean {a}': lap(5, lean=a) for a in (-20, 0, 20)},
    'lap 3': lap(3),
    'vee 6, root 2': vee(6, 2),
    'vee 8, root 1.5, 45 degrees': vee(8, 1.5, angle=45),
    'vee whose plates noise joins to its bevels': vee(8, 1.5, angle=45, noise=0.1),
    **{f'corner of {a} degrees': corner(a) for a in (90, 120, 135)},
    'tee 12': tee(12),
    'tee 12, lean 30': tee(12, lean=30),
    'tee 30, lean 45': tee(30, lean=45),
    'butt 3, backing 5, spatter': butt(3, 5, spatter=20),
    'lap 5, spatter': lap(5, spatter=20),
}


# -- seams


START, PERIOD = 1_700_000_000_000_000_000, 10_000_000
KINDS = {'butt': 'butt', 'lap': 'lap', 'vee': 'v', 'tee': 'fillet', 'corner': 'fillet'}
QUICK = ('butt 2, lean 15, bent', 'tee 30, lean 45')
# lean 45: the rough seam bends at its ends


def preform():
    return preform_cloud(np.random.default_rng(0), 0.12, 5e-4)


def joint_of(name, seed=0):
    return scanned(replace(JOINTS[name], length=40.0), np.random.default_rng(seed))


def away_from(truth, T):
    """
    Return how far frames (n, 4, 4) are from the true line, square to it (n,).

    And the largest angle between approach and true normal, square to the seam too (degrees).
    """
    _, index = cKDTree(truth.centre).query(T[:, :3, 3])
    tangent = np.gradient(truth.centre, axis=0)[index]
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    offset = T[:, :3, 3] - truth.centre[index]
    normal = np.cross(np.cross(tangent, truth.normals[index]), tangent)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return (np.linalg.norm(np.cross(offset, tangent), axis=1),
            np.degrees(np.arccos(-(T[:, :3, 1] * normal).sum(axis=1).max())))


def test_centre_line_and_approach_of_a_preform_are_the_true_ones():
    truth = preform()
    seam = find_seam(truth.points, towards=-truth.normals.mean(axis=0))
    frames = tool_frames(seam, 5e-3)
    away, angle = away_from(truth, frames.T_base_tool)
    assert seam.kind == 'lap' and seam.sections.noise == pytest.approx(1e-4, rel=0.1)
    assert away.max() < 1e-4 and angle < 1.0
    std = frames.measures[:, 3]
    assert std.max() < 5e-5 and np.sqrt((away ** 2).mean()) < 2 * std.mean()
    assert 0 < frames.arc_lengths[0] < 0.02  # the ends are not certain enough
    assert 'no frames on the first' in ' '.join(sentences(seam, frames))
    with pytest.raises(DataError, match='scan more densely'):
        tool_frames(replace(seam, sections=replace(
            seam.sections, resolution={seam.line: 5e-5})), 5e-3)


@pytest.mark.parametrize('name', [
    *QUICK, *long_run(*(name for name in JOINTS
                        if name not in (*QUICK, 'tee 12', 'butt 3, backing 5, spatter')))])
def test_joints_as_a_sensor_sees_them(name):
    truth = joint_of(name, 1)
    seam = find_seam(truth.points)
    frames = tool_frames(seam, 5e-3)
    assert seam.kind == KINDS[name.split()[0]]
    away, angle = away_from(truth, frames.T_base_tool)
    assert away.max() < 1e-4 and angle < 1.0
    assert seam.curve.length == pytest.approx(0.04, abs=1e-3)
    assert frames.measures[:, 2].max() < 10 * seam.sections.noise
    if name == 'vee 6, root 2':
        assert seam.line == 'root'
        told = sentences(seam, frames)[-1]
        assert 'seams of another kind (butt, 39.2 mm long at x y z = ' in told
        assert frames.measures[:, 0] == pytest.approx(2e-3, abs=1.5e-4)


def test_the_path_follows_what_is_asked_for_from_where_it_is_asked():
    points = joint_of('lap 5, lean -20').points
    second = find_seam(points, line='second')
    last = second.curve.position(second.curve.last)
    turned = find_seam(points, line='first', start=last)  # from the other end, now the first
    assert (second.line, turned.line) == ('second', 'first')
    assert np.linalg.norm(turned.curve.position(turned.curve.first) - last) < 2e-4
    np.testing.assert_allclose(second.std(second.curve.arc[1]),
                               turned.std(turned.curve.arc[1][::-1]), rtol=0.01)


def test_the_sigma_of_a_cubic_path_knows_how_far_it_is_from_the_sections():
    joint = replace(JOINTS['lap 5, lean -20'], length=100.0)
    seam = find_seam(scanned(joint, np.random.default_rng(0)).points)
    t, line = seam.curve.arc[1], seam.curves[seam.line]
    assert (seam.curve.kind, line.kind) == ('cubic', 'spline')
    off = np.linalg.norm(seam.curve.position(t) - line.position(t), axis=1)
    assert off.max() > 1e-6
    np.testing.assert_allclose(seam.std(t)[:, 0] ** 2, off ** 2 + line.std(t) ** 2
                               + seam.sections.resolution[seam.line] ** 2)


def test_frames_are_rotations_at_the_pitch_and_lean_as_asked():
    truth = preform()
    towards = -truth.normals.mean(axis=0)
    seam = find_seam(truth.points, towards=towards)
    frames = tool_frames(seam, 3e-3, 0.2, -0.1)
    R = frames.T_base_tool[:, :3, :3]
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (len(R), 1, 1)),
                               atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)
    np.testing.assert_allclose(np.diff(frames.arc_lengths)[:-1], 3e-3)
    steps = np.linalg.norm(np.diff(frames.T_base_tool[:, :3, 3], axis=0), axis=1)[:-1]
    np.testing.assert_allclose(steps, 3e-3, rtol=1e-3)  # chords of a weakly bent curve
    for way in (towards, -towards):
        turned = tool_frames(replace(seam, towards=way), 0.02)
        assert (turned.T_base_tool[:, :3, 1] @ way > 0.8).all()
    plain = tool_frames(seam, 0.02).T_base_tool
    for angle, axis in (('travel', 2), ('work', 0)):
        leant = tool_frames(seam, 0.02, **{angle: 0.3}).T_base_tool
        cosine = (plain[:, :3, 1] * leant[:, :3, 1]).sum(axis=1)
        np.testing.assert_allclose(np.arccos(cosine), 0.3, atol=1e-9)
        np.testing.assert_allclose((plain[:, :3, axis] * leant[:, :3, 1]).sum(axis=1), 0,
                                   atol=1e-12)


@pytest.mark.parametrize(('shape', 'words'), [
    (STAIRS, '2 lap seams .*--box'),
    (butt(3, 5, missing=12.0), '2 butt seams .*, 1[0-9].* mm apart.* scan again'),
    (butt(14, 5), '2 lap seams .*, 14 mm apart.* larger --widest'), *long_run(
        (vee(6, 1.5, noise=0.15), r'sheets beside the v seam are 0\.\d+ mm thick.* less noise'),
        (lap(0.3), r'no seam.* noise is 0\.03\d* mm, .* for a corner'))])
def test_why_there_is_no_single_seam_is_named(shape, words):
    truth = scanned(replace(shape, length=40.0), np.random.default_rng(0))
    with pytest.raises(DataError, match=words):
        find_seam(truth.points)


def test_the_root_of_a_v_is_known_up_to_the_ends_of_the_part():
    """Where the points on the end of a bevel face those of the other bevel too."""
    rng = np.random.default_rng(1)
    x = np.repeat(np.arange(0, 0.06, 4e-4), 200)
    u = (np.tile(np.arange(200), 150) + rng.random(len(x))) * 2e-4 - 0.02
    z = np.minimum(0, (np.abs(u) - 4e-3) * 5 / 4) + 3e-5 * rng.normal(size=len(x))
    seam = find_seam(np.column_stack([x, u, z]))
    y, height = tool_frames(seam, 5e-3).T_base_tool[:, 1:3, 3].T
    assert seam.kind == 'v' and np.hypot(y, height + 5e-3).max() < 1e-4


@pytest.mark.parametrize('angle', [
    60, *long_run(70, 80, 100)])
def test_the_root_of_a_steep_fillet_is_found_up_to_the_end_of_the_cloud(angle):
    rng = np.random.default_rng(angle)
    x, y = np.meshgrid(np.arange(-0.015, 0.015, 2e-4), np.arange(0, 0.05, 3e-4))
    z = np.abs(x) / np.tan(np.radians(angle / 2)) + 2e-5 * rng.normal(size=x.shape)
    points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    seam = find_seam(points, towards=(0.0, 0.0, -1.0))
    root = seam.sections.lines['root']
    assert seam.kind == 'fillet' and np.hypot(root[:, 0], root[:, 2]).max() < 1.5e-4
    with pytest.raises(DataError, match='scan more densely'):
        find_seam(points[points[:, 1] < 0.004])
    with pytest.raises(DataError, match='in metres'):
        find_seam(points * 1e3)


@pytest.mark.thorough
def test_the_path_is_as_near_to_a_wavy_seam_as_it_says():
    rng = np.random.default_rng(0)
    x, u = rng.uniform(0, 0.15, 60000), rng.uniform(-0.02, 0.02, 60000)
    x, u = x[np.abs(u) > 1e-3], u[np.abs(u) > 1e-3]
    wave = 2 * np.pi / 0.15
    points = np.column_stack([x, u + 3e-3 * np.sin(wave * x), 5e-5 * rng.normal(size=len(x))])
    frames = tool_frames(find_seam(points), 5e-3)
    x, y, z = frames.T_base_tool[:, :3, 3].T
    away = np.hypot((y - 3e-3 * np.sin(wave * x)) / np.hypot(1, 3e-3 * wave * np.cos(wave * x)), z)
    assert away.max() < 8e-5
    assert (away < 3.44 * frames.measures[:, 3]).mean() > 0.95


@pytest.mark.thorough
def test_clouds_of_other_things_are_refused():
    rng = np.random.default_rng(0)
    flat = rng.uniform(-0.03, 0.03, (12000, 2))
    plane = np.column_stack([flat, np.zeros(len(flat))])
    ring = np.column_stack([flat, 4e-3 * (np.hypot(*flat.T) > 0.018)])
    ragged = scanned(butt(4, 5), rng).points
    along = (ragged - ragged.mean(axis=0)) @ np.linalg.svd(
        ragged - ragged.mean(axis=0), full_matrices=False)[2][0]
    uneven = ragged[np.sin(along / 2e-3) + 0.01 * np.arange(len(along)) % 1 < 0.8]
    for points, words in (
            (ring, 'a lap seam is .*closed'), (plane, 'no seam'),
            (plane[np.hypot(*flat.T) > 4e-3], 'no seam'),
            (rng.normal(size=(3000, 3)), 'no seam'), (np.zeros((1000, 3)), 'fewer than 500'),
            (joint_of('tee 12').points, 'no seam.* tilted'), (uneven, 'seam'),
            # parted by spatter
            (joint_of('butt 3, backing 5, spatter', 1).points, '2 butt seams')):
        with pytest.raises(DataError, match=words):
            find_seam(points)


def test_a_straight_seam_is_a_cubic_and_a_wound_one_a_spline():
    t = np.linspace(0, 1, 200)
    noise = np.random.default_rng(0).normal(size=(200, 3)) * 1e-5
    bent = np.column_stack([0.2 * t, 0.01 * t ** 2, 0.02 * t ** 3]) + noise
    wound = np.column_stack([0.2 * t, 0.01 * np.sin(9 * t), 0 * t]) + noise
    index = np.arange(1.0, 201.0)
    assert spline(index, bent).simplified().kind == 'cubic'
    curve = spline(index, wound).simplified()
    assert curve.kind == 'spline'
    line = curve.position(np.linspace(curve.first, curve.last, 2000))
    assert cKDTree(wound - noise).query(line)[0].max() < 6.5e-4  # half a step of the points
    points = np.column_stack([0.1 * t, 0.02 * t ** 2, 0 * t])
    for curve in (spline(index, points), spline(index, points).simplified()):
        assert curve.length == pytest.approx(0.1025, rel=5e-3)
        for at in (1.0, 100.0, 200.0):
            np.testing.assert_allclose(curve.position(at), points[int(at) - 1], atol=1e-6)
            assert np.linalg.norm(curve.tangent(at)) == pytest.approx(1.0)


def test_the_verb_writes_what_others_read(tmp_path):
    truth = preform()
    rows = np.zeros(len(truth.points), [(axis, '<f4') for axis in 'xyz'])
    for axis, column in zip('xyz', truth.points.T, strict=True):
        rows[axis] = column
    write_cloud(tmp_path / 'c.pcd', [rows])
    towards = [str(v) for v in -truth.normals.mean(axis=0)]
    succeeds('seam', 'c.pcd', '--out', 'seam', '--bag', '--towards', *towards,
             '--pitch', '5 mm', '--box', '-inf', 'inf', '-3m', '300cm', '-3', '3',
             '--start', '0mm', '0', '0', cwd=tmp_path)
    result = yaml.safe_load((tmp_path / 'seam/seam.yaml').read_text())
    assert result['kind'] == 'lap'
    rows = np.genfromtxt(tmp_path / 'seam/seam.csv', delimiter=',', names=True)
    assert len(rows) == len(result['frames'])
    types = get_typestore(Stores.ROS2_JAZZY)
    with Reader(tmp_path / 'seam/path') as reader:
        messages = {c.msgtype: types.deserialize_cdr(data, c.msgtype)
                    for c, _, data in reader.messages()}
    path, poses = messages['nav_msgs/msg/Path'], messages['geometry_msgs/msg/PoseArray']
    assert path.header.frame_id == poses.header.frame_id == 'base'
    assert [p.position.x for p in poses.poses] == pytest.approx(list(rows['x']), abs=1e-8)
    assert [p.pose.orientation.w for p in path.poses] == pytest.approx(list(rows['qw']), abs=1e-8)
    for words, code, sentence in (
            (('c.pcd', '--widest', '0.5mm'), 3, '--widest'), (('bag',), 2, '--calibration'),
            (('c.pcd', '--pitch', '5'), 2, '5mm, or 5m if'),
            (('c.pcd', '--widest', '0mm'), 2, 'at least 0.1 mm'),
            (('c.pcd', '--towards', '0', '0', '0'), 2, 'a direction'),
            (('c.pcd', '--box', '1', '0', *4 * ('inf',)), 2, 'lower limit first'),
            (('c.pcd', '--set', 'profile.unit=mm'), 2, 'for a bag'),
            (('c.pcd', '--start', '0', '', '0'), 2, '--start is')):
        assert_refused(handeye('seam', *words, cwd=tmp_path), code, sentence)
    assert not (tmp_path / 'out').exists()


def test_the_verb_on_a_recording(tmp_path):
    """A step of 5 mm at x = 0, along y of the base, seen from above."""
    rng, profiles, poses = np.random.default_rng(0), [], []
    for k in range(150):
        x = np.sort(rng.uniform(-0.02, 0.02, 160))
        z = np.where(x < 0, 0.2, 0.205) + 2e-5 * rng.normal(size=160)
        profiles.append(Profile(START + k * PERIOD, 'laser', np.column_stack([x, z])))
        poses.append(TimedPose(START + k * PERIOD, np.array([0.0, 3e-4 * k, 0.2]),
                               np.array([1.0, 0.0, 0.0, 0.0])))
    writer.write(tmp_path / 'bag', profiles, poses)
    write_calibration(calibration_at(np.eye(4)), tmp_path / 'c.yaml')
    succeeds('seam', 'bag', '--calibration', 'c.yaml', cwd=tmp_path)
    rows = np.genfromtxt(tmp_path / 'out/seam/seam.csv', delimiter=',', names=True)
    assert len(rows) >= 7 and np.ptp(rows['y']) > 0.03
    np.testing.assert_allclose(rows['x'], 0, atol=1.5e-4)
    np.testing.assert_allclose(rows['z'], -2.5e-3, atol=5e-5)
