# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The configuration: every default, its range and its description, in one place.

A dotted key (`noise.sensor`) is a ROS parameter of the node, a key of the YAML files in config/
and a `--set` key of the command line. Metres, radians and seconds throughout.
"""
from handeye_ros.config.keys import (
    BASE_FRAME,
    Config,
    flatten,
    GuidanceConfig,
    LimitsConfig,
    NoiseConfig,
    PageConfig,
    Parameter,
    parameters,
    ProfileConfig,
    RECORD,
    RECORD_NAMES,
    SamplesConfig,
    SamplingConfig,
    SAVE_FORMATS,
    SaveConfig,
    SIGNED_AXES,
    TargetConfig,
    TrackerConfig,
    UNNAMED_FRAME,
    VerifyConfig,
)
from handeye_ros.config.values import (
    EVERY_NODES,
    flipped_range,
    from_provenance,
    load,
    NODE,
    with_assignments,
    with_values,
    yaml_content,
)

__all__ = [
    'Config', 'EVERY_NODES', 'GuidanceConfig', 'LimitsConfig', 'NODE', 'NoiseConfig',
    'PageConfig', 'Parameter', 'ProfileConfig', 'RECORD', 'RECORD_NAMES', 'SAVE_FORMATS',
    'SIGNED_AXES', 'SamplesConfig', 'SamplingConfig', 'SaveConfig', 'TargetConfig',
    'TrackerConfig', 'BASE_FRAME', 'UNNAMED_FRAME', 'VerifyConfig', 'flatten', 'flipped_range',
    'from_provenance', 'load', 'parameters', 'with_assignments', 'with_values', 'yaml_content']
