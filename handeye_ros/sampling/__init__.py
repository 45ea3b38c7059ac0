"""
When the robot stood still, and what it saw there.

Streams of profiles and poses become dwells, stops and samples, or passes of a moving robot;
the session holds them.
"""

OFFERED = (
    'dwells.NS', 'edge_shapes.consistent_edges', 'errors.ClearedError', 'errors.ClocksDifferError',
    'errors.FlatCrossingError', 'errors.NoStationsError', 'errors.NothingNewError',
    'errors.SilentPosesError', 'passes.Pairing', 'passes.problem_of', 'passes.single_samples',
    'profile_buffer.MOST_BACK', 'session.Session', 'station_features', 'station_features.evenly',
    'station_features.features_of', 'stops.Outcome', 'stops.Seen', 'stops.Stop', 'stops.judged',
    'stops.needed', 'stops.result_of', 'stops.sample_of', 'time_offset.evenly_chosen',
    'time_offset.synchronised',
)
