# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a recording or a session shows: its samples, and the evidence of a saved calibration."""
from __future__ import annotations

from pathlib import Path

from handeye_ros import pipeline, tabulated
from handeye_ros.bags.bag import read
from handeye_ros.bags.session import is_session, read_session
from handeye_ros.config import Config
from handeye_ros.data import Calibration
from handeye_ros.results.evidence import config_of, Evidence, recording_of
from handeye_ros.sampling.session import Session


def session_of(path: Path, config: Config) -> Session:
    """
    Return the samples of a bag, or of the folder of a session.

    The stops of a session are stored one by one, and some were taken again or taken back: they
    are no recording in the order of time. Raises InputError for what cannot be read, DataError
    where it holds no stations.
    """
    if is_session(path):
        return read_session(path).session(config)
    recording = read(path, config)
    return pipeline.gather(recording.profiles, recording.poses, config)


def evidence(calibration: Calibration, bag: Path | None, folder: Path = Path()) -> Evidence:
    """
    Return the evidence of a recording; bag: None for the one named in the calibration.

    folder: that holds the calibration's file. Without a recording, `missing` gives the reason.
    Raises InputError for an unreadable bag.
    """
    config = config_of(calibration)
    if tabulated.of(config):
        return Evidence(missing='stops are shown of recordings; this was solved from files')
    missing = ''
    if bag is None:
        bag, missing = recording_of(calibration, folder)
    if bag is None:
        return Evidence(missing=missing)
    return pipeline.evidence(session_of(bag, config), config)
