"""`python -m handeye_ros` is `handeye`."""
from handeye_ros.cli import main

main()
