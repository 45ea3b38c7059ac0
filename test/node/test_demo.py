"""What `make demo` runs: node and replay in processes of their own, and a client."""
from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from handeye_ros.results.calibration_file import read_calibration  # noqa: E402, I100
from handeye_ros.results.truth_file import mapped_point_error, true_transform  # noqa: E402
from ros_helpers import ROOT, run_module  # noqa: E402

pytestmark = pytest.mark.ros

PLATE = str(ROOT / 'config' / 'plate.yaml')


def demo(bag: Path | str, out: Path, config: str = PLATE):
    return run_module('demo', '--bag', str(bag), '--config', config, '--out', str(out),
                      '--rate', '10')


def test_the_demo_leaves_the_calibration_and_tells_its_error(tmp_path: Path) -> None:
    bag = ROOT / 'bags' / 'plate'
    path = tmp_path / 'calibration.yaml'
    path.write_text('of another run')
    run = demo(bag, tmp_path)
    assert run.returncode == 0, run.stderr
    assert f'wrote {path}; the previous result is kept in {tmp_path}/history/' in run.stdout
    (former,) = tmp_path.glob('history/*/calibration.yaml')
    assert former.read_text() == 'of another run'
    assert 'samples so far: ' in run.stdout
    report = tmp_path / 'report.html'
    assert run.stdout.endswith(f'wrote {report}: open it in a browser\n')
    assert 'Good for mapping points of laser into flange' in report.read_text()
    assert 'error against truth.yaml: translation 0.0' in run.stdout
    T_true = true_transform(bag)
    assert T_true is not None
    saved = read_calibration(path)
    assert mapped_point_error(saved.T_flange_sensor, T_true) < 9e-5
    assert [set(item) for item in saved.provenance['inputs']] == [
        {'topic'}, {'topic'}, {'path', 'sha256'}]
    assert saved.provenance['config']['output_dir'] == str(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {
        'calibration.yaml', 'history', 'node.log', 'report.html'}


@pytest.mark.thorough
def test_a_refusal_ends_with_3_and_leaves_the_former_result(tmp_path: Path) -> None:
    (tmp_path / 'calibration.yaml').write_text('of another run')
    run = demo(ROOT / 'bags' / 'one_orientation', tmp_path)
    assert run.returncode == 3
    assert run.stderr.startswith('~/compute_calibration was refused: all poses share one ')
    assert sorted(p.name for p in tmp_path.iterdir()) == ['calibration.yaml', 'node.log']
    assert (tmp_path / 'calibration.yaml').read_text() == 'of another run'


@pytest.mark.thorough
@pytest.mark.parametrize(('bag', 'config', 'reason'), [
    ('no/such/bag', PLATE, 'no/such/bag: no such file or folder'),
    (str(ROOT / 'bags' / 'plate'), 'no.yaml', 'cannot read the configuration no.yaml'),
])
def test_wrong_input(tmp_path: Path, bag: str, config: str, reason: str) -> None:
    run = demo(bag, tmp_path, config)
    assert run.returncode == 2
    assert run.stderr.startswith(reason)
