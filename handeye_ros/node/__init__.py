"""The node: streams, services, messages."""
