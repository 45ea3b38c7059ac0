# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Simulated recordings with known truth, without ROS.

`simulate` renders profiles and poses; `simulate_samples` makes the features directly; `FAULTS`
are cells with the faults of real ones; `FILE_SCENES` make files of measured values.
"""
from handeye_ros.simulate.recording import (
    settings,
    simulate,
    simulate_samples,
    Simulated,
    TrueStop,
    Truth,
)
from handeye_ros.simulate.scenario import FAULTS, Scenario, SCENARIOS
from handeye_ros.simulate.tables import FILE_SCENES, SimulatedFiles

__all__ = ['FAULTS', 'FILE_SCENES', 'SCENARIOS', 'Scenario', 'Simulated', 'SimulatedFiles',
           'TrueStop', 'Truth', 'settings', 'simulate', 'simulate_samples']
