# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The published algorithms, one file per paper, as their authors wrote them.

Most are for `handeye compare`; but jing2020 is the estimator of the laser tracker, and its fixed
point and spheres, and A X = X B of park1994, are starts of others. They take plain arrays, and
of the package know only transforms, errors and the fit of a circle. Beyond the papers they
refuse too few data, and data that leave an unknown free; where a print is wrong the docstring says
so and what was done.
"""
