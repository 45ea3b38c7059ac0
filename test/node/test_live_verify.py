"""A verification in a running session without ROS: what counts, what it says, what it writes."""
from __future__ import annotations

from pathlib import Path

from handeye_ros import se3
from handeye_ros.bags.bag import read
from handeye_ros.bags.session_store import OutputFolders
from handeye_ros.config import Config, load, with_values
from handeye_ros.data import Calibration, Profile, Quality, TimedPose
from handeye_ros.errors import DataError, HandeyeError
from handeye_ros.node.live import LiveSession
from handeye_ros.node.status import state_of
from handeye_ros.results.calibration_file import write_calibration
from handeye_ros.results.truth_file import true_transform
from handeye_ros.verification import session as sessions
from handeye_ros.verification.verification import FORMAT
import numpy as np
import pytest
from recordings import halves
import yaml

ROOT = Path(__file__).parents[2]
SPHERE = load(ROOT / 'config' / 'sphere.yaml')


def running(tmp_path: Path, config: Config = SPHERE, **values: object) -> LiveSession:
    return LiveSession(changed(config, output_dir=str(tmp_path), **values), OutputFolders())


def changed(config: Config, **values: object) -> Config:
    return with_values(config, {key.replace('__', '.'): v for key, v in values.items()}, 'test')


def feed(live: LiveSession, profiles, poses) -> None:
    for item in sorted([*poses, *profiles], key=lambda item: item.stamp):
        if isinstance(item, TimedPose):
            live.add_poses([item])
        else:
            live.add_profile(item)
    live.samples.evaluate_all()


@pytest.fixture(scope='module')
def parts():
    """Return a recording in two parts: for the calibration, and for its verification."""
    return halves(read(ROOT / 'bags' / 'sphere', SPHERE), 8)


@pytest.fixture(scope='module')
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return files of calibrations: the truth of the recording, and a wrong one."""
    folder = tmp_path_factory.mktemp('calibrations')
    T = true_transform(ROOT / 'bags' / 'sphere')
    std = np.repeat([3e-5, 1.7e-4], 3)
    found = {}
    for name, off in (('right', np.zeros(6)), ('wrong', np.array([1e-3, 0, 0, 0, 9e-3, 0]))):
        found[name] = str(folder / f'{name}.yaml')
        write_calibration(Calibration(
            name, 'sphere', 'flange', 'laser', se3.perturb(T, off), np.diag(std ** 2),
            {}, Quality(0, 0, 0.0, 0.0, '', 0.0), ()), Path(found[name]))
    return found


def test_stops_after_the_start_verify_and_are_no_samples(tmp_path: Path, parts) -> None:
    live = running(tmp_path, verify__routine='sphere', verify__radius=0.04)
    feed(live, *parts[0])
    live.answer.compute()
    before = [outcome.number for outcome in live.copied().outcomes]
    assert live.verification.begin().startswith('sphere: 0 usable stops of 0; move on')
    assert 'stops are not samples' in ' '.join(state_of(live).session.notes)
    feed(live, *parts[1])
    # the last one too, while the robot stands there
    assert live.verification.text == 'sphere: 6 usable stops of 6'
    text = live.verification.result()
    assert text.startswith('sphere: PASS, 6 stations; radius ')
    assert [outcome.number for outcome in live.copied().outcomes] == before
    assert state_of(live).calibration.state == 'current'
    written = tmp_path / 'sphere' / 'verification_sphere.yaml'
    assert str(written) in text
    report = yaml.safe_load(written.read_text())
    assert (report['format'], report['verdict'], report['stations']) == (FORMAT, 'pass', 6)
    assert report['inputs'] == ['/profile', '/flange_pose']
    with pytest.raises(DataError, match='no verification was started'):
        live.verification.result()
    assert not state_of(live).session.notes


def test_the_verdict_is_that_of_the_file_that_is_set(tmp_path: Path, parts, files) -> None:
    live = running(tmp_path, verify__routine='sphere', verify__radius=0.04,
                   verify__calibration=files['wrong'])
    live.verification.begin()
    feed(live, *parts[1])
    assert live.verification.result().startswith('sphere: FAIL, 6 stations; ')


def test_refusals_in_words_and_what_goes_on_after_them(tmp_path: Path, parts, files) -> None:
    live = running(tmp_path)

    def refused(ask, *words: str) -> None:
        with pytest.raises(HandeyeError) as report:
            ask()
        for word in words:
            assert word in str(report.value)

    def with_settings(**values: object) -> None:
        live.configure(changed(live.config, **values))

    refused(live.verification.result, 'no verification was started', 'call ~/verify_start')
    refused(live.verification.begin, 'verify.routine is not set')
    with_settings(verify__routine='spere')
    refused(live.verification.begin, 'no routine "spere"', 'did you mean "sphere"')
    with_settings(verify__routine='ball_bar')
    refused(live.verification.begin, 'ball_bar needs 1 lengths')
    with_settings(verify__routine='sphere')
    refused(live.verification.begin, 'there is no calibration to verify')
    with_settings(verify__calibration=str(tmp_path / 'none.yaml'))
    refused(live.verification.begin, 'none.yaml')
    with_settings(verify__calibration=files['right'])
    live.verification.begin()
    early, late = halves(parts[1], 2)
    feed(live, *early)
    refused(live.verification.result, '2 usable stations, fewer than 4')
    feed(live, *late)
    with_settings(verify__radius=0.04, verify__tolerance=6e-5)
    with pytest.raises(DataError, match='insensitive: an error of the calibration'):
        live.verification.result()
    with_settings(verify__tolerance=3e-4)
    assert live.verification.result().startswith('sphere: PASS, 6 stations')
    assert not live.copied().outcomes


def test_another_routine_ends_a_verification(tmp_path: Path, parts, files) -> None:
    live = running(tmp_path, verify__routine='sphere', verify__calibration=files['right'])
    live.verification.begin()
    live.configure(changed(live.config, verify__routine=''))
    feed(live, *parts[1])
    assert len(live.copied().outcomes) >= 5  # the robot stands in the sixth


def test_of_a_long_pass_so_many_profiles_are_kept_evenly() -> None:
    part = sessions.Part()
    for k in range(10 * sessions.MOST_PROFILES):
        part.add_profile(Profile(k, 'laser', np.zeros((2, 2))))
    kept = np.array([p.stamp for p in part.profiles])
    assert sessions.MOST_PROFILES <= len(kept) <= 2 * sessions.MOST_PROFILES
    assert len(set(np.diff(kept))) == 1
    assert kept[-1] > 9.9 * sessions.MOST_PROFILES
