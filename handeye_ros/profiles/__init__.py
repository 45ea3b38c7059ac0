"""What one profile shows: straight pieces, faces and edges, arcs."""
