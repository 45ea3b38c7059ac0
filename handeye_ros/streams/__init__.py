"""
Messages over time: the order of their stamps, and the pose of the flange at any time.

What cannot belong to a stream is left out and counted.
"""

OFFERED = (
    'errors.ClocksApartError', 'errors.TimeBackwardsError', 'errors.TwoFramesError', 'stream.FEW',
    'stream.FEW_SHARE', 'stream.LARGEST_STEP', 'stream.Stream', 'stream.around', 'stream.in_order',
    'stream.interpolate', 'stream.never_falls', 'trajectory.Instants', 'trajectory.Trajectory',
    'trajectory.joined', 'trajectory.track_of', 'trajectory.trajectory_of',
)
