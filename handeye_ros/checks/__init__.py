"""What is refused and named: motion, conventions, moves, shape, misfit."""
