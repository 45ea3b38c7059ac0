# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A running session without ROS: verification, whose stops are no samples."""
from __future__ import annotations

import hashlib
from itertools import islice
from pathlib import Path

from cells import recorded
from handeye_ros.errors import DataError, InputError
from handeye_ros.node.state import state_of
from live_sessions import (
    changed,
    computed,
    fed,
    feed,
    feed_one,
    later,
    new,
    PARTS,
    TO_VERIFY,
    update,
    verdict,
)
import pytest
import yaml


def test_stops_after_the_start_verify_and_are_no_samples() -> None:
    live = new(TO_VERIFY)
    with pytest.raises(DataError, match='no verification was started'):
        verdict(live)
    with pytest.raises(DataError, match='there is no calibration to verify'):
        live.verification.verify_start()
    feed(live, PARTS[0].messages)
    computed(live)
    before = [stop.number for stop in live.session_copy().stops]
    changed(live, verify__routine='tooth', verify__lengths=(0.015, 0.005))
    with pytest.raises(InputError, match='call "handeye verify tooth"'):
        live.verification.verify_start()
    changed(live, verify__routine='sphere', verify__lengths=())
    assert live.verification.verify_start().startswith('sphere: 0 usable stops of 0; move on')
    assert 'stops are not samples' in ' '.join(state_of(live)['session']['warnings'])
    with pytest.raises(DataError, match='0 usable stations, fewer than 4'):
        verdict(live)
    feed(live, PARTS[1].messages)
    text = verdict(live)
    assert text.startswith('sphere: PASS, 6 stations; radius ')
    assert [stop.number for stop in live.session_copy().stops] == before
    assert state_of(live)['calibration']['state'] == 'current'
    written = Path(live.folders.folder(live.config)) / 'verification_sphere.yaml'
    assert str(written) in text
    report = yaml.safe_load(written.read_text())
    assert (report['verdict'], report['stations']) == ('pass', 6)
    assert report['created'] and not report['calibration_file']  # it is the answer, no file
    assert not state_of(live)['session']['warnings']
    live.solver.save_calibration()
    live.verification.verify_start()
    feed(live, later(PARTS[1].messages, 1000))
    verdict(live)
    file = written.parent / 'calibration.yaml'
    assert yaml.safe_load(written.read_text())['calibration_file'] == {
        'path': str(file), 'sha256': hashlib.sha256(file.read_bytes()).hexdigest()}


def test_the_stop_in_which_a_verification_is_given_up_is_no_sample() -> None:
    live = fed(TO_VERIFY, PARTS[0])
    computed(live)
    before = [stop.number for stop in live.session_copy().stops]
    live.verification.verify_start()
    for item in (items := iter(PARTS[1].messages)):
        feed_one(live, item)
        if live.to_evaluate:
            update(live)
        if '1 usable stops' in live.verification.text:
            break
    changed(live, verify__routine='')
    for item in islice(items, 100):  # until the robot has moved on
        feed_one(live, item)
    update(live)
    assert [stop.number for stop in live.session_copy().stops] == before


def test_a_verification_begun_anew_says_what_is_dropped() -> None:
    live = fed(TO_VERIFY, PARTS[0])
    computed(live)
    live.verification.verify_start()
    changed(live, verify__lengths=(0.1,))
    feed(live, PARTS[1].messages)
    with pytest.raises(InputError, match='sphere needs 0 lengths'):
        verdict(live)
    changed(live, verify__lengths=(), verify__tolerance=1e-5)
    with pytest.raises(DataError, match='^sphere: INSENSITIVE, 6 stations; ') as refused:
        verdict(live)
    assert str(refused.value).count('decides nothing') == 1, 'each reason once'
    changed(live, verify__tolerance=3e-4)
    assert verdict(live).startswith('sphere: PASS, 6 stations; ')
    live.verification.verify_start()
    feed(live, later(PARTS[1].messages, 1000))
    assert live.verification.verify_start().endswith(
        '; what was measured before is dropped (sphere: 6 usable stops of 6)')


def test_more_lengths_ask_for_more_recordings_and_drop_none() -> None:
    live, face = fed(TO_VERIFY, PARTS[0]), recorded('plane')
    computed(live)
    changed(live, verify__routine='step', verify__lengths=(0.01,))
    live.verification.verify_start()  # two faces
    for k in range(2):
        feed(live, later(face.messages, 1000 * (k + 1)))
        if k == 1:
            assert not live.verification.has_next_recording
            changed(live, verify__lengths=(0.01, 0.02, 0.03))  # four faces or more
        answer = live.verification.verify_start()
        assert f'recording {k + 2}:' in answer and 'dropped' not in answer
