# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The evidence of a calibration: from a recording, and from a session in any order."""
from __future__ import annotations

from pathlib import Path

from command import ROOT
from handeye_ros import pipeline
from handeye_ros.bags.bag import read
from handeye_ros.bags.session import SessionFiles
from handeye_ros.config import load
from handeye_ros.evidence import evidence


def test_stops_that_were_taken_again_are_no_second_run(tmp_path: Path) -> None:
    """Taken again, they lie in the session twice, and not in the order of their stamps."""
    config = load(ROOT / 'config' / 'plate.yaml')
    recording = read(ROOT / 'bags' / 'plate', config)
    session = pipeline.gather(recording.profiles, recording.poses, config)
    store = SessionFiles(lambda config: tmp_path)
    outcomes = session.outcomes
    for outcome in (*outcomes, *outcomes[:3]):
        store.add(outcome, config)
    folder = Path(store.path)
    store.close()
    calibration = pipeline.calibrate_session(session, config)
    shown = evidence(calibration, folder)
    assert not shown.refusal and not shown.missing
    assert len(shown.stops) == len(outcomes) and all(stop.used for stop in shown.stops)
