"""The executor of the node, and what other threads destroy while it waits."""
from __future__ import annotations

import subprocess
import sys

from command import PATIENCE
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')

pytestmark = pytest.mark.ros

START = """
from handeye_ros.ros.executable import InvalidHandle, ros, spin
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.waitable import NumberOfEntities, Waitable
from rclpy.callback_groups import ReentrantCallbackGroup
"""
GONE = START + """
class Gone(Waitable):
    def __init__(self):
        super().__init__(ReentrantCallbackGroup())
        self.asked = 0

    __enter__ = lambda self: self
    __exit__ = lambda self, *_: None
    get_num_entities = lambda self: NumberOfEntities()
    is_ready = lambda self, _: False

    def add_to_wait_set(self, _):
        self.asked += 1
        if self.asked == 2:
            raise InvalidHandle('destruction was requested')

with ros():
    node, executor, gone = Node('spins'), MultiThreadedExecutor(2), Gone()
    node.add_waitable(gone)
    executor.add_node(node)
    node.create_timer(0.01, lambda: gone.asked > 3 and executor.context.try_shutdown())
    try:
        spin(executor)
    except Exception as error:
        print(type(error).__name__)
    print(gone.asked > 3)
"""
ANEW = START + """
from handeye_ros.ros.node.publishers import latched_publisher
from std_msgs.msg import String

with ros():
    node = Node('publishes')
    before = list(node.waitables)
    publisher = latched_publisher(node, String, '~/text')
    print(list(node.waitables) == before)
"""


@pytest.mark.parametrize('script', [GONE, ANEW], ids=['goes on', 'waits for no publisher'])
def test_what_is_destroyed_meanwhile_does_not_end_it(script: str) -> None:
    said = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True,
                          check=False, timeout=PATIENCE)
    assert said.stdout.splitlines()[-1:] == ['True'], said.stdout + said.stderr
