"""How the node offers a service: whoever has gone away before the answer must not end it."""
from __future__ import annotations

from typing import Any

from handeye_ros.ros.executable import InvalidHandle, RCLError
import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile

REQUESTS = QoSProfile(depth=1000)  # that wait for a solve; ROS would drop all but ten
UNSENDABLE = (RCLError, InvalidHandle)


def offer(node: Node, kind: Any, name: str, callback: Any, group: CallbackGroup) -> None:
    """Create a service of a node; an answer that nobody takes is told in the log."""
    service = node.create_service(kind, f'~/{name}', callback, callback_group=group,
                                  qos_profile=REQUESTS)
    send = service.send_response

    def respond(response: Any, header: Any) -> None:
        try:
            send(response, header)
        except UNSENDABLE as error:
            if rclpy.ok():
                node.get_logger().warning(f'nobody took the answer of ~/{name}: {error}')

    service.send_response = respond
