"""What samples say of each other and of the clocks, and what was seen at each stop, in words."""
