# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Publishes a bag on its own topics with /clock, at a given rate."""
from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from importlib import import_module
import math
from pathlib import Path
import sys
import time

from handeye_ros.bags.storage import Reader, RecordedMessage
from handeye_ros.errors import InputError
from handeye_ros.node.executables import non_ros_arguments, ros, run_for_exit_code
from handeye_ros.node.streams import STATIC_TF_QOS
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

CLOCK_PERIOD = 0.02  # s between two messages on /clock
# s before the first message and after the last one: a publisher discovers a subscriber slightly
# before the subscriber discovers it, and best-effort subscribers acknowledge nothing.
DISCOVERY_TIME = 0.5
ACKNOWLEDGE_TIMEOUT = Duration(seconds=10)


def replay(bag: Path, rate: float = 1.0, timeout: float = 5.0) -> None:
    """
    Publish a bag, and return when all messages are sent.

    rate: the speed, 1 as it was recorded. It starts once all topics have a subscriber, after
    timeout (s) in any case. Raises InputError for a bag that cannot be read or holds nothing to
    publish, and for a rate that is no positive number.
    """
    if not (math.isfinite(rate) and rate > 0):
        raise InputError(f'the rate is {rate:g}, expected a number above 0')
    reader = Reader(bag)
    recorded = list(reader.messages())
    reader.types.pop('/clock', None)  # there is one, at this rate
    for warning in reader.warnings:
        print(warning, file=sys.stderr)
    with ros():
        node = Node('handeye_replay')
        clock = node.create_publisher(Clock, '/clock', 10)
        publishers = _publishers(node, reader.types)
        messages = sorted((message for message in recorded if message.topic in publishers),
                          key=lambda message: message.log_time)
        if not messages:
            raise InputError(f'{bag} holds no messages of a type that is installed here')
        end = time.monotonic() + timeout
        while missing := [topic for topic, publisher in publishers.items()
                          if not publisher.get_subscription_count()]:
            if time.monotonic() > end:
                print(f'no subscriber on {", ".join(missing)}; starting anyway', file=sys.stderr)
                break
            time.sleep(CLOCK_PERIOD)
        time.sleep(DISCOVERY_TIME)
        _publish_all(messages, publishers, clock, rate)
        for publisher in publishers.values():
            publisher.wait_for_all_acked(ACKNOWLEDGE_TIMEOUT)
        time.sleep(DISCOVERY_TIME)


def _publishers(node: Node, topics: Mapping[str, str]) -> dict[str, Publisher]:
    """Return a publisher for each topic with an installed type; report the others."""
    publishers = {}
    for topic, type_name in topics.items():
        package, _, name = type_name.replace('/msg/', '/').partition('/')
        try:
            message_type = getattr(import_module(f'{package}.msg'), name)
        except (AttributeError, ImportError):
            print(f'{topic} is not played: {type_name} is not installed', file=sys.stderr)
            continue
        qos = STATIC_TF_QOS if topic == '/tf_static' else QoSProfile(depth=1000)
        publishers[topic] = node.create_publisher(message_type, topic, qos)
    return publishers


def _publish_all(messages: Sequence[RecordedMessage], publishers: Mapping[str, Publisher],
                 clock: Publisher, rate: float) -> None:
    """Publish every message at its time; rate: of the bag's time to real time."""
    first, begin = messages[0].log_time, time.monotonic()

    def bag_time() -> int:
        return first + round((time.monotonic() - begin) * rate * 1e9)

    for message in messages:
        while (ahead := (message.log_time - bag_time()) * 1e-9 / rate) > 0:
            clock.publish(Clock(clock=Time(nanoseconds=bag_time()).to_msg()))
            time.sleep(min(ahead, CLOCK_PERIOD))
        publishers[message.topic].publish(message.data)
    clock.publish(Clock(clock=Time(nanoseconds=messages[-1].log_time).to_msg()))


def main() -> int:
    """Run the executable `replay`."""
    parser = argparse.ArgumentParser(prog='replay', description=__doc__)
    parser.add_argument('bag', type=Path, help='a rosbag2 folder, or an .mcap or .db3 file')
    parser.add_argument('--rate', type=float, default=1.0, help='speed; 1: as recorded')
    parser.add_argument('--timeout', type=float, default=5.0,
                        help='start after so many seconds in any case (default: 5)')
    options = parser.parse_args(non_ros_arguments())
    return run_for_exit_code(replay, options.bag, options.rate, options.timeout)


if __name__ == '__main__':
    sys.exit(main())
