"""
Every verb of the command `handeye`, each of which wraps one function of the library.

One file per group of verbs; importing it here makes its verbs known.
"""
from handeye_ros.cli import (
    batch,
    calibrate,
    check,
    kinematics,
    plan,
    recordings,
    results,
    scan,
    seam,
    session,
    trend,
    verify,
)
from handeye_ros.cli.common import app

__all__ = ['app', 'batch', 'calibrate', 'check', 'kinematics', 'plan', 'recordings', 'results',
           'scan', 'seam', 'session', 'trend', 'verify']
