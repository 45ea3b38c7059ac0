"""
What one profile shows: straight pieces, faces and edges, arcs.

Takes the points of one profile or of a stop, and knows no robot.
"""

OFFERED = (
    'arcs.arc_features', 'arcs.arcs_of_each', 'arcs.normal_points', 'circles.fit_circle',
    'lines.corner_features', 'edge_rounding.RADII', 'edge_rounding.reach',
    'faces.face_features', 'faces.plane_features', 'lines.combined_line', 'lines.on_line',
    'segment.Segment', 'segment.noise_level',
    'segment.straight_segments',
)
