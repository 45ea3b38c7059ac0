"""
When the robot stood still, and what it saw there.

Streams of profiles and poses become dwells, stops and samples, or passes of a moving robot;
the session holds them.
"""
