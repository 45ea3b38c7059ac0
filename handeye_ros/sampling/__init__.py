"""When the robot stood still, and what it saw there."""
