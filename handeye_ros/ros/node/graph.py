"""What else is published: told to a user whose node hears nothing."""
from __future__ import annotations

from rclpy.node import Node

LISTED = 5


def elsewhere(node: Node, topic: str, wanted: str) -> str:
    """
    Return why nothing of the wanted type is heard on a topic, as far as the others show it.

    Empty where a publisher of the type is there.
    """
    name = node.resolve_topic_name(topic)
    types = {info.topic_type for info in node.get_publishers_info_by_topic(name)}
    if wanted in types:
        return ''
    why = (f'it carries {", ".join(sorted(types))}, expected {wanted}' if types else
           f'nobody publishes {name}')
    others = _topics_of(node, wanted)
    return why + (f'; {wanted} is on {", ".join(others[:LISTED])}' if others else '')


def _topics_of(node: Node, wanted: str) -> list[str]:
    """Return the topics on which others publish messages of a type."""
    names = [name for name, types in node.get_topic_names_and_types() if wanted in types]
    me = (node.get_name(), node.get_namespace())
    return sorted(name for name in names
                  if any((info.node_name, info.node_namespace) != me and info.topic_type == wanted
                         for info in node.get_publishers_info_by_topic(name)))
