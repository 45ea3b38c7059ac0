# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Builds PointCloud2 messages of any layout, without ROS, and reads them."""
from __future__ import annotations

from types import SimpleNamespace

from handeye_ros.bags.messages import DATATYPES, profile_from_cloud
from handeye_ros.config import ProfileConfig
import numpy as np

METRES = ProfileConfig()


def field(name, offset, datatype=7, count=1):
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


def cloud(columns, layout, point_step, *, height=1, row_padding=0, bigendian=False, fill=0xa5):
    """
    Return a message with the columns {name: (n,) values} at layout {name: (offset, datatype)}.

    Whatever lies between the columns and behind the rows is filled with a byte.
    """
    n = len(next(iter(columns.values())))
    width = n // height
    row_step = width * point_step + row_padding
    data = np.full(height * row_step, fill, np.uint8)
    for name, values in columns.items():
        offset, datatype = layout[name]
        dtype = np.dtype(('>' if bigendian else '<') + DATATYPES[datatype])
        view = np.ndarray((height, width), dtype, data, offset, (row_step, point_step))
        view[:] = np.asarray(values).reshape(height, width)
    fields = [field(name, *layout[name]) for name in columns]
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1_700_000_000, nanosec=1), frame_id='laser')
    return SimpleNamespace(header=header, height=height, width=width, fields=fields,
                           is_bigendian=bigendian, point_step=point_step, row_step=row_step,
                           data=data, is_dense=True)


def points(msg, config=METRES):
    return profile_from_cloud(msg, config).points


def expected(x, z):
    """Return what a profile must hold of two columns, by the text of the design."""
    both = np.array([x, z], dtype=float).T
    both[~np.isfinite(both).all(axis=1)] = np.nan
    return both
