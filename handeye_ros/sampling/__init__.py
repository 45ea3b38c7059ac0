"""
When the robot stood still, and what it saw there.

Streams of profiles and poses become dwells, stops and samples, or passes of a moving robot;
the session holds them.
"""

OFFERED = (
    'dwells.NS', 'dwells.interpolate', 'edge_shapes.consistent_edges', 'errors.ClearedError',
    'errors.ClocksApartError', 'errors.ClocksDifferError', 'errors.FlatCrossingError',
    'errors.NoStationsError', 'errors.NothingNewError', 'errors.SilentPosesError',
    'errors.TimeBackwardsError', 'errors.TwoFramesError', 'passes.Pairing', 'passes.problem_of',
    'passes.single_samples', 'profile_buffer.MOST_BACK', 'session.Session', 'station_features',
    'station_features.evenly', 'station_features.features_of', 'stops.Outcome', 'stops.Seen',
    'stops.Stop', 'stops.judged', 'stops.needed', 'stops.result_of', 'stops.sample_of',
    'stream.FEW', 'stream.FEW_SHARE', 'stream.LARGEST_STEP', 'stream.Stream', 'stream.in_order',
    'stream.never_falls', 'time_offset.evenly_chosen', 'time_offset.synchronised',
    'trajectory.Trajectory', 'trajectory.track_of',
)
