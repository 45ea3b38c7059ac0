# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""An arm in kinematics.yaml is read as it was written."""
from __future__ import annotations

from dataclasses import replace

from calibrations import CALIBRATION
from handeye_ros import se3
from handeye_ros.arm import Arm, Joint, KINDS, OFFSET, PRISMATIC, REVOLUTE
from handeye_ros.results import kinematics_file
import numpy as np
import pytest


@pytest.mark.parametrize('kinds', [(), (OFFSET,), KINDS])
def test_an_arm_is_read_as_it_was_written(tmp_path, kinds):
    rng = np.random.default_rng(4)
    placed = se3.perturb(np.eye(4), rng.normal(size=(3, 6)))
    arm = Arm('base', 'tool0', (
        Joint('rail', PRISMATIC, placed[0], np.array([0.0, 1.0, 0.0]), -1.0, 2.0),
        Joint('a', REVOLUTE, placed[1], se3.unit(rng.normal(size=3)))), placed[2])
    arm = arm.with_errors_of(kinds)
    size = len(arm.error_values)
    root = rng.normal(size=(size, size))
    arm = replace(arm, error_values=rng.normal(size=size), covariance=root @ root.T,
                  configurations=rng.normal(size=(5, 2)).round(6))
    (tmp_path / kinematics_file.NAME).write_text(
        kinematics_file.text(arm, np.ones(size), (), 0.0, CALIBRATION))
    again = kinematics_file.read_arm(tmp_path)
    assert (again.base, again.flange, again.estimated_kinds) == ('base', 'tool0', kinds)
    for joint, same in zip(arm.joints, again.joints, strict=True):
        assert (joint.name, joint.type, joint.lower, joint.upper) == (
            same.name, same.type, same.lower, same.upper)
        np.testing.assert_allclose(same.origin, joint.origin, atol=1e-15)
        np.testing.assert_array_equal(same.axis, joint.axis)
    np.testing.assert_allclose(again.end, arm.end, atol=1e-15)
    for name in ('error_values', 'covariance', 'configurations'):
        np.testing.assert_array_equal(getattr(again, name), getattr(arm, name))
