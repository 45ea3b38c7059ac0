"""The evidence of a saved calibration: the stops of its recording, for a report."""
from __future__ import annotations

from pathlib import Path

from handeye_ros import pipeline, tabulated
from handeye_ros.bags.bag import read
from handeye_ros.data import Calibration
from handeye_ros.results.evidence import config_of, Evidence, recording_of


def evidence(calibration: Calibration, bag: Path | None) -> Evidence:
    """
    Return the evidence of a recording; bag: None for the one named in the calibration.

    Without a recording, `missing` gives the reason. Raises InputError for an unreadable bag.
    """
    config = config_of(calibration)
    if tabulated.of(config):
        return Evidence(missing='stops are shown of recordings; this was solved from files')
    missing = ''
    if bag is None:
        bag, missing = recording_of(calibration)
    if bag is None:
        return Evidence(missing=missing)
    recording = read(bag, config)
    return pipeline.evidence(recording.profiles, recording.poses, config)
