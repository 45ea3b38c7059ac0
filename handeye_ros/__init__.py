"""Hand-eye calibration of laser line profilers, offline and as a ROS 2 node."""

__version__ = '0.1.0'
