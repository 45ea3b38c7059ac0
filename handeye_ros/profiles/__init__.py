"""
What one profile shows: straight pieces, faces and edges, arcs.

Takes the points of one profile or of a stop, and knows no robot.
"""
