"""The robot's own error: joints and axes that differ from its URDF, found with the same target."""
