"""Control charts of what was verified and checked: limits, states, files."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.batch.charts import charts
from handeye_ros.cli import command
from handeye_ros.verification import verification
import numpy as np
import pytest
from typer.testing import CliRunner
from verifications import measured, result
import yaml

HEIGHTS = ('step: height of face 1 over face 0, deviation',
           'step: height of face 2 over face 0, deviation',
           'step: height of face 3 over face 0, deviation')


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Return a folder with six verifications and two checks; from the fifth on a height is off."""
    folder = tmp_path_factory.mktemp('trend')
    made, found = measured('step')
    report = result('step', made, found)
    rng = np.random.default_rng(1)
    for day in range(6):
        quantities = [replace(q, value=q.nominal + q.std * rng.normal()
                              + 6 * q.std * (day >= 4 and k == 1))
                      for k, q in enumerate(report.quantities)]
        one = replace(report, quantities=tuple(quantities),
                      recorded=f'2026-03-0{day + 1}T08:00:00')
        (folder / f'{9 - day}.yaml').write_text(verification.yaml_text(one))
    for k, evidence in enumerate((1e-4, 3e4)):
        (folder / f'check_{k}.yaml').write_text(yaml.safe_dump({
            'format': 'handeye_ros/check/2', 'checks': [{
                'stamp': 1_700_000_000_000_000_000 + k, 'evidence': evidence,
                'verdict': 'sensor' if k else 'unchanged'}]}))
    (folder / 'other.yaml').write_text('a: 1')
    return folder


def test_a_value_that_leaves_its_limits_is_marked_since_when(folder):
    found, warnings = charts(folder)
    states = {chart.name: chart.states for chart in found}
    assert not warnings
    assert states[HEIGHTS[1]][4:] == ['action', 'action']
    assert [p.recorded[:10] for p in found[0].points] == [f'2026-03-0{k}' for k in range(1, 7)]
    for name in (HEIGHTS[0], HEIGHTS[2]):
        assert 'action' not in states[name]
    assert states['check: log10 of the evidence for a change'] == ['', 'action']


def test_the_verb_draws_and_writes_them(folder, tmp_path):
    run = CliRunner().invoke(command(), ['trend', str(folder), '--csv', str(tmp_path / 't.csv'),
                                         '--picture', str(tmp_path / 't.png')])
    assert run.exit_code == 0, (run.output, run.exception)
    assert 'action 2026-03-05' in run.output.replace('\n', ' ')
    assert (tmp_path / 't.png').stat().st_size > 5000
    rows = (tmp_path / 't_measured.csv').read_text().splitlines()
    assert rows[0].startswith('chart,unit,recorded') and len(rows) == 1 + 6 * 4 + 2
    assert not (tmp_path / 't.csv').exists()  # there is no calibration


def test_a_file_that_cannot_be_read_is_left_out_and_named(tmp_path):
    (tmp_path / 'v.yaml').write_text('format: handeye_ros/verification/1\nverdict: pass')
    found, warnings = charts(tmp_path)
    assert not found and 'v.yaml is left out' in warnings[0]
    assert CliRunner().invoke(command(), ['trend', str(tmp_path)]).exit_code == 3
