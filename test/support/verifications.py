# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Verifications of simulated artefacts, as the bench makes them."""
from __future__ import annotations

from dataclasses import replace

from calibrations import calibration_at
from command import bench_of
from handeye_ros.config import Config
from handeye_ros.verification.routines import ROUTINES
from handeye_ros.verification.verify import verify_stops
import numpy as np

bench = bench_of('verify')


def bench_calibration(X, name='plate', provenance=None, offset=None, target=None):
    """Return a calibration with the uncertainty of the bench."""
    return calibration_at(X, name=name, method=name, covariance=np.diag(bench.STD ** 2),
                          target=target or {}, provenance=provenance or {}, time_offset=offset)


def measure(name, seed=0, **values):
    rng = np.random.default_rng(seed)
    artefact = bench.SCENES[name](rng, **values)
    return artefact, bench.calibration(artefact.T_flange_sensor, bench.covariance(rng))


def assess(name, artefact, calibration, config=None, **stated):
    routine, config = ROUTINES[name], config or Config(noise=bench.NOISE)
    config = replace(config, verify=replace(config.verify, **{
        'lengths': artefact.lengths, 'radius': bench.RADIUS if 'ball' in name else 0.0,
        'reference': artefact.reference, 'aim': bench.AIM if name == 'point' else 0.0} | stated))
    return verify_stops(routine, artefact.bags, calibration, config)
