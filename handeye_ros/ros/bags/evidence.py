"""What the recording of a calibration shows of it, for the report."""
from __future__ import annotations

from pathlib import Path

from handeye_ros import files, pipeline
from handeye_ros.data import Calibration
from handeye_ros.results.report.evidence import config_of, Evidence, recording_of
from handeye_ros.ros.bags.bag import read


def evidence(calibration: Calibration, bag: Path | None) -> Evidence:
    """
    Return what a recording shows; bag: None for the one that the calibration names.

    Where there is none, its `missing` says why. Raises InputError for a bag that cannot be read.
    """
    config = config_of(calibration)
    if files.of(config):
        return Evidence(missing='stops are shown of recordings; this was solved from files')
    missing = ''
    if bag is None:
        bag, missing = recording_of(calibration)
    if bag is None:
        return Evidence(missing=missing)
    recording = read(bag, config)
    return pipeline.evidence(recording.profiles, recording.poses, config)
