# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
When the robot stood still, and what it saw there.

A *stop* is a time during which the robot stood still; a *pass*, two seconds of a moving robot,
goes the same way. It becomes one *sample*, that of a pass with a sample for each of its profiles.
In the order of the data:

1. stream.py: the messages of each topic in the order of their stamps
2. stops.py: the poses cut into stops and passes, with the profiles of their time
3. features.py: the sample of a stop, with the poses of interpolation.py; that of a pass also has a
   trajectory (trajectory.py)
4. session.py leads the messages and stops through 1 to 3 and keeps the results; input_faults.py
   says why some cannot be used
5. of all samples together, before the solve: sweep.py finds the clocks of a moving robot,
   edge_shapes.py the shape of the edges of the target
"""
