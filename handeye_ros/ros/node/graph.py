"""What else is published: told to a user whose node hears nothing."""
from __future__ import annotations

from rclpy.node import Node

LISTED = 5


HINTS = {
    'geometry_msgs/msg/Pose': ', as a Pose has no time',
    'geometry_msgs/msg/PoseWithCovarianceStamped': ', without the covariance',
    'geometry_msgs/msg/TransformStamped': ' (or set pose_source to tf)',
    'sensor_msgs/msg/LaserScan': ': let the driver publish its points',
    'sensor_msgs/msg/PointCloud': ', its successor',
}


def elsewhere(node: Node, key: str, topic: str, wanted: str) -> str:
    """
    Return why nothing of the wanted type is heard on a topic, as far as the others show it.

    key: of the configuration that names the topic.

    Empty where a publisher of the type is there.
    """
    name = node.resolve_topic_name(topic)
    types = {info.topic_type for info in node.get_publishers_info_by_topic(name)}
    if wanted in types:
        return ''
    hints = ''.join(HINTS.get(kind, '') for kind in sorted(types))
    why = (f'it carries {", ".join(sorted(types))}, expected {wanted}{hints}' if types else
           f'nobody publishes {name}')
    others = _topics_of(node, wanted)
    return why + (f'; {wanted} is on {", ".join(others[:LISTED])}: set {key}' if others else '')


def namesake(node: Node) -> str:
    """Return that another node has the same name, and what to do; empty where none has."""
    me = (node.get_name(), node.get_namespace())
    if node.get_node_names_and_namespaces().count(me) < 2:
        return ''
    return (f'there are two nodes {node.get_fully_qualified_name()}: both take samples, and '
            'either may answer; end one, or rename it (-r __node:=other). One that was killed '
            'is listed for 20 s more')


def _topics_of(node: Node, wanted: str) -> list[str]:
    """Return the topics on which others publish messages of a type."""
    names = [name for name, types in node.get_topic_names_and_types() if wanted in types]
    me = (node.get_name(), node.get_namespace())
    return sorted(name for name in names
                  if any((info.node_name, info.node_namespace) != me and info.topic_type == wanted
                         for info in node.get_publishers_info_by_topic(name)))
