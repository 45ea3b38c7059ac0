"""
The next pose that helps most.

What is determined so far, what is missing, and poses within the limits of the robot.
"""
