"""Run the node: python -m handeye_ros.ros.node."""
import sys

from handeye_ros.ros.node.main import main

sys.exit(main())
