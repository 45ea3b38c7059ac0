"""The browser page at the cell: the state of the node, and its services as buttons."""
