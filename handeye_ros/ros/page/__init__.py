"""The page for a browser at the cell: what the node tells, and its services as buttons."""
