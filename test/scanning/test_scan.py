# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Profiles and poses to a cloud in the base: exact, at constant memory, in files others read."""
from __future__ import annotations

from dataclasses import replace
import tracemalloc

from command import assert_refused, handeye, succeeds
from handeye_ros import se3
from handeye_ros.bags import writer
from handeye_ros.config import Config, NoiseConfig
from handeye_ros.data import Profile, TimedPose
from handeye_ros.errors import DataError, InputError
from handeye_ros.results.calibration_file import write_calibration
from handeye_ros.sampling.trajectory import trajectory_of
from handeye_ros.scanning.cloud import frame_of, read_cloud, write_cloud
from handeye_ros.scanning.scan import point_std, Scanner, ScanOptions
from moving_scan import calibration, moving, plane_profile, plane_profiles, STEP, T0, true_flange
import numpy as np
from plyfile import PlyData, PlyElement
import pypcd4
import pytest
from recordings import POINTS, with_layout

GAP = 0.5


def scanned(scanner, profiles, poses):
    return np.concatenate(list(scanner.scan(profiles, trajectory_of(poses, GAP))))


def xyz(cloud):
    return np.stack([cloud[axis] for axis in 'xyz'], axis=1).astype(float)


def test_profiles_without_a_pose_on_both_sides_are_dropped_and_counted():
    poses = moving(200)
    poses = [p for p in poses if not 50 * STEP < p.stamp - T0 < 100 * STEP]
    scanner = Scanner(calibration(), Config(), ScanOptions())
    profiles = plane_profiles(240)
    cloud = np.concatenate(list(scanner.scan(profiles, trajectory_of(poses, 0.02))))
    lost = [p for p in profiles if 50 < (p.stamp - T0) / STEP < 100 or p.stamp > poses[-1].stamp]
    assert scanner.without_pose == len(lost)
    assert len(cloud) == (240 - len(lost)) * 50
    scanner = Scanner(calibration(), Config(), ScanOptions())
    with pytest.raises(DataError, match='none of the 3 profiles'):
        scanned(scanner, [replace(p, stamp=p.stamp + 10**12) for p in profiles[:3]], poses)


@pytest.mark.parametrize('case', ['plain', 'time offset', 'rotation lag', 'stray pose'])
def test_points_of_a_moving_sensor_lie_where_they_were_seen(case):
    """The plane z = 0.1; with stamps that are early, rotations reported late, a wrong stamp."""
    profiles, poses, known = plane_profiles(200), moving(200), calibration()
    if case == 'time offset':
        profiles = [replace(p, stamp=p.stamp - 20 * STEP) for p in profiles]
    if case == 'rotation lag':
        poses = [replace(p, quaternion=q.quaternion)
                 for p, q in zip(poses[4:], poses[:-4], strict=True)]
        profiles, known = profiles[30:180], replace(known, target={'rotation_lag': 0.020})
    if case == 'stray pose':
        poses.insert(10, TimedPose(T0 + 10**15, np.zeros(3), np.array([0.0, 0, 0, 1])))
    config = Config(time_offset=0.020 if case == 'time offset' else 0.0)
    scanner = Scanner(known, config, ScanOptions())
    cloud = xyz(scanned(scanner, profiles, poses))
    assert len(cloud) == scanner.kept == len(profiles) * 50
    np.testing.assert_allclose(cloud[:, 2], 0.1, atol=2e-7)  # single precision


def test_eye_on_base_and_the_axes_of_the_driver_are_followed():
    X, T = calibration().T_flange_sensor, true_flange(7.0)
    for values, axes, mount, point in (
            ({'calibration_type': 'eye_on_base'}, ('x', 'z'), se3.inverse(T), [0.01, 0, 0.17, 1]),
            ({}, ('-y', 'z'), T, [0, -0.01, 0.17, 1])):
        scanner = Scanner(calibration(), Config(**values), ScanOptions())
        profile = Profile(T0 + 7 * STEP, 'laser', np.array([[0.01, 0.17]]), axes=axes)
        cloud = xyz(scanned(scanner, [profile], moving(200)))
        np.testing.assert_allclose(cloud[0], (mount @ X @ point)[:3], atol=1e-7)
        assert scanner.frame == ('flange' if values else 'base')


def test_points_beyond_the_limits_of_range_and_incidence_are_dropped():
    x = np.linspace(-0.02, 0.02, 401)
    z = np.where(x < 0, 0.15, 0.15 + 2 * x)  # flat, then 63 degrees
    profile = Profile(T0 + STEP, 'laser', np.column_stack([x, z]))
    flat = Scanner(calibration(), Config(), ScanOptions(incidence=np.deg2rad(45)))
    assert abs(len(scanned(flat, [profile], moving(200))) - 200) < 6
    near = Scanner(calibration(), Config(), ScanOptions(farthest=0.16))
    assert len(scanned(near, [profile], moving(200))) == (z <= 0.16).sum()
    nothing = Scanner(calibration(), Config(), ScanOptions(nearest=1.0))
    with pytest.raises(DataError, match='widen the limits'):
        scanned(nothing, [profile], moving(200))


@pytest.mark.parametrize('degrees', [-30.0, 91.0, np.nan])
def test_an_incidence_that_is_none_is_refused(degrees):
    with pytest.raises(InputError, match='--incidence is .*, expected 0 to 90 degrees'):
        ScanOptions.of_texts(('-inf', 'inf'), degrees, '0', std=False)


def test_exchanged_limits_of_the_range_are_refused():
    with pytest.raises(InputError, match='--range is .*, expected the smaller reading first'):
        ScanOptions.of_texts(('200mm', '100mm'), 90.0, '0', std=False)


def test_thinning_keeps_one_point_of_each_cube():
    scanner = Scanner(calibration(), Config(), ScanOptions(voxel=2e-3))
    thin = xyz(scanned(scanner, plane_profiles(200), moving(200)))
    every = Scanner(calibration(), Config(), ScanOptions())
    full = xyz(scanned(every, plane_profiles(200), moving(200)))
    cubes = {tuple(c) for c in np.floor(full / np.float32(2e-3)).astype(int)}
    assert len({tuple(c) for c in np.floor(thin / np.float32(2e-3)).astype(int)}) == len(thin)
    assert abs(len(thin) - len(cubes)) < 0.02 * len(cubes)  # of the two roundings
    assert scanner.thinned == len(full) - len(thin)


def test_the_std_of_a_point_is_that_of_many_trials():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6)) * np.repeat([2e-5, 3e-4], 3)[:, None]
    noise = NoiseConfig(sensor=3e-5, robot_translation=4e-5, robot_rotation=1e-4)
    cal = calibration(root @ root.T)
    point, T = np.array([0.01, 0.19]), true_flange(3.0)
    s = np.array([point[0], 0.0, point[1]])
    trials = []
    for _ in range(4000):
        X = se3.perturb(cal.T_flange_sensor, root @ rng.normal(size=6))
        turn = se3.exp_rotation(rng.normal(size=3) * 1e-4)
        p = X[:3, :3] @ (s + [0, 0, rng.normal() * 3e-5]) + X[:3, 3]
        trials.append(turn @ T[:3, :3] @ p + T[:3, 3] + rng.normal(size=3) * 4e-5)
    scatter = np.sqrt(np.var(trials, axis=0).sum())
    result = point_std(cal, noise, (cal.T_flange_sensor[:3, :3] @ s)[None], np.zeros(2))[0]
    assert result == pytest.approx(scatter, rel=0.04)


@pytest.mark.thorough
def test_memory_does_not_grow_with_the_length(tmp_path):
    def peak(repeats):
        profiles, track = plane_profiles(200, 400), trajectory_of(moving(200), GAP)
        scanner = Scanner(calibration(), Config(), ScanOptions(std=True))
        tracemalloc.start()
        every = (p for _ in range(repeats) for p in profiles)
        write_cloud(tmp_path / 'cloud.ply', scanner.scan(every, track))
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    assert peak(8) < 1.1 * peak(2)


FIELDS = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('intensity', '<f4')])


@pytest.mark.parametrize('count', [0, 12345])
def test_other_libraries_read_the_clouds(tmp_path, count):
    rng = np.random.default_rng(count)
    cloud = np.empty(count, FIELDS)
    for name in FIELDS.names:
        cloud[name] = rng.normal(size=count)
    for name in ('c.ply', 'c.pcd'):
        write_cloud(tmp_path / name, np.array_split(cloud, 3), 'frame süd, metres')
        assert frame_of(tmp_path / name) == 'süd'
    ply = PlyData.read(tmp_path / 'c.ply')['vertex']
    pcd = pypcd4.PointCloud.from_path(tmp_path / 'c.pcd')
    assert ply.count == pcd.points == count
    for k, name in enumerate(FIELDS.names):
        np.testing.assert_array_equal(ply[name], cloud[name])
        np.testing.assert_array_equal(pcd.numpy()[:, k], cloud[name])
    for name in ('c.ply', 'c.pcd'):
        np.testing.assert_array_equal(read_cloud(tmp_path / name), xyz(cloud))


def test_clouds_of_others_are_read(tmp_path):
    points = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    dtype = [('x', 'f4'), ('y', 'f4'), ('z', 'f4')]
    rows = np.array([tuple(p) for p in points], dtype)
    for text in (True, False):
        PlyData([PlyElement.describe(rows, 'vertex')], text=text, byte_order='<').write(
            tmp_path / 'o.ply')
        np.testing.assert_allclose(read_cloud(tmp_path / 'o.ply'), points, rtol=1e-6)
    cloud = pypcd4.PointCloud.from_xyz_points(points)
    for encoding in (pypcd4.Encoding.ASCII, pypcd4.Encoding.BINARY):
        cloud.save(tmp_path / 'o.pcd', encoding)
        np.testing.assert_allclose(read_cloud(tmp_path / 'o.pcd'), points, rtol=1e-6)
    (tmp_path / 'o.pcd').write_text('FIELDS normal x y z\nSIZE 4 4 4 4\nTYPE F F F F\n'
                                    'COUNT 3 1 1 1\nPOINTS 1\nDATA ascii\n0 0 1 10 20 30\n')
    np.testing.assert_array_equal(read_cloud(tmp_path / 'o.pcd'), [[10, 20, 30]])
    even = pypcd4.PointCloud.from_xyz_points(np.ones((7, 3), np.float32))
    even.save(tmp_path / 'o.pcd', pypcd4.Encoding.BINARY_COMPRESSED)
    with pytest.raises(InputError, match='not compressed'):
        read_cloud(tmp_path / 'o.pcd')


def test_damaged_clouds_are_refused_and_one_that_breaks_off_is_not_there(tmp_path):
    path = tmp_path / 'c.ply'
    with pytest.raises(ZeroDivisionError):
        write_cloud(path, (np.ones(3 // k, FIELDS) for k in (1, 0)))
    assert not list(tmp_path.iterdir())
    write_cloud(path, [np.ones(10, FIELDS)])
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    with pytest.raises(InputError, match='9 of 10'):
        read_cloud(path)
    for text in (b'', b'ply\n', b'ply\nformat ascii 1.0\nelement vertex x\nend_header\n',
                 b'ply\nformat ascii 1.0\nelement vertex 1\nproperty float a\nend_header\n1\n'):
        path.write_bytes(text)
        with pytest.raises(InputError):
            read_cloud(path)


@pytest.mark.filterwarnings('error')
def test_of_an_ascii_cloud_without_points_numpy_does_not_warn(tmp_path):
    path = tmp_path / 'c.ply'
    head = ''.join(f'property float {axis}\n' for axis in 'xyz') + 'end_header\n'
    path.write_text(f'ply\nformat ascii 1.0\nelement vertex 0\n{head}')
    assert read_cloud(path).shape == (0, 3)
    path.write_text(f'ply\nformat ascii 1.0\nelement vertex 4\n{head}')
    with pytest.raises(InputError, match='is cut off: 0 of 4 points'):
        read_cloud(path)


def test_the_verb_writes_a_cloud_with_intensity(tmp_path):
    write_calibration(calibration(), tmp_path / 'calibration.yaml')
    beside = replace(plane_profile(0), points=np.empty((0, 2)))  # the part
    writer.write(tmp_path / 'bag', [beside, *plane_profiles(101)[1:]], moving(101))
    bag = with_layout(tmp_path / 'bag', tmp_path, POINTS['scancontrol'])
    run = succeeds('scan', bag, '--calibration', 'calibration.yaml', '--out', 'c.ply',
                   '--std', '--range', '-1m', 'inf', '--voxel', '0um', cwd=tmp_path)
    assert run.stdout.startswith('101 profiles, 5000 returns\n')
    vertex = PlyData.read(tmp_path / 'c.ply')['vertex']
    assert [p.name for p in vertex.properties] == ['x', 'y', 'z', 'intensity', 'std']
    np.testing.assert_allclose(vertex['z'], 0.1, atol=1e-6)
    assert 'of the frame' not in run.stderr
    other = replace(calibration(), child_frame='other')
    write_calibration(other, tmp_path / 'calibration.yaml')
    run = succeeds('scan', bag, '--calibration', '.', '--out', 'c.ply', cwd=tmp_path)
    assert 'the profiles are of the frame "laser", and the calibration is of "other"' in run.stderr


@pytest.mark.once
def test_the_verb_refuses_in_words(tmp_path):
    write_calibration(calibration(), tmp_path / 'calibration.yaml')
    writer.write(tmp_path / 'bag', plane_profiles(10), moving(10))
    for words, code, sentence in (
            (('c.xyz',), 2, '.ply or .pcd'),
            (('c.ply', '--set', 'profile_topic=a'), 2, 'no topic /a'),
            (('c.ply', '--set', 'time_offset=5'), 3, 'none of the 10 profiles'),
            (('c.ply', '--range', '150', '200'), 2, '150mm')):
        run = handeye('scan', 'bag', '--calibration', 'calibration.yaml', '--out', *words,
                      cwd=tmp_path)
        assert_refused(run, code, sentence)
    assert not (tmp_path / 'c.ply').exists()


def test_sparse_poses_of_a_curved_way_are_interpolated_smoothly():
    """Poses at 20 Hz: linearly, points were off by 39 um RMS."""
    cal = calibration()

    def flange(at):
        way = np.array([0.6 + 0.05 * np.cos(at * 2e-3), 0.05 * np.sin(at * 2e-3), 0.4])
        return se3.transform(se3.exp_rotation(np.array([0.2 * np.sin(2e-3 * at), 0, 0])), way)
    poses = [TimedPose(T0 + k * STEP, flange(k)[:3, 3], se3.quaternion(flange(k)))
             for k in range(0, 4001, 50)]
    at = np.arange(505, 3500, 10)
    profiles = [Profile(T0 + int(k) * STEP, 'laser', np.array([[0.01, 0.2]])) for k in at]
    cloud = xyz(scanned(Scanner(cal, Config(), ScanOptions()), profiles, poses))
    true = np.array([se3.apply(flange(k) @ cal.T_flange_sensor, np.array([[0.01, 0, 0.2]]))[0]
                     for k in at])
    assert np.sqrt(((cloud - true) ** 2).sum(axis=1).mean()) < 6e-6


@pytest.mark.thorough
def test_the_std_tells_how_well_the_poses_are_known():
    """Few poses of much noise; what was configured of the robot does not cover it."""
    rng, cal = np.random.default_rng(2), calibration()
    profiles, off, stds = plane_profiles(2000, 1), [], []
    for _ in range(8):
        poses = [replace(p, translation=p.translation + rng.normal(size=3) * 2e-4)
                 for p in moving(2000, 50)]
        config = Config(noise=NoiseConfig(sensor=1e-9, robot_translation=0, robot_rotation=0))
        cloud = scanned(Scanner(cal, config, ScanOptions(std=True)), profiles, poses)
        off.append(cloud['z'] - 0.1)
        stds.append(cloud['std'])
    assert np.std(off) * np.sqrt(3) == pytest.approx(np.sqrt(np.mean(np.square(stds))), rel=0.15)
