#!/usr/bin/env python3
"""Writes config/handeye.policy.xml from a running node: python tools/make_policy.py [FILE]."""
from __future__ import annotations

from pathlib import Path
import subprocess
import sys
import time
from typing import Any
from xml.etree import ElementTree as ET

POLICY = Path(__file__).parents[1] / 'config' / 'handeye.policy.xml'
NODE = 'handeye'
PAUSE, ALIKE = 0.2, 10  # s between two looks; how many must show the same


def used(observer: Any) -> dict[tuple[str, str], list[str]]:
    """Return the names of what the node publishes, subscribes and serves, as a node sees it."""
    ask = {('topics', 'publish'): observer.get_publisher_names_and_types_by_node,
           ('topics', 'subscribe'): observer.get_subscriber_names_and_types_by_node,
           ('services', 'reply'): observer.get_service_names_and_types_by_node}
    return {kind: sorted(name.replace(f'/{NODE}/', '~/') for name, _ in names(NODE, '/'))
            for kind, names in ask.items()}


def policy(found: dict[tuple[str, str], list[str]]) -> str:
    """Return the text of an SROS2 policy that allows that and nothing else."""
    root = ET.Element('policy', version='0.2.0')
    enclave = ET.SubElement(ET.SubElement(root, 'enclaves'), 'enclave', path=f'/{NODE}')
    profile = ET.SubElement(ET.SubElement(enclave, 'profiles'), 'profile', ns='/', node=NODE)
    for (group, right), names in found.items():
        section = ET.SubElement(profile, group, {right: 'ALLOW'})
        for name in names:
            ET.SubElement(section, group.removesuffix('s')).text = name
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'


def steady(observer: Any, process: subprocess.Popen[bytes]) -> dict[tuple[str, str], list[str]]:
    """Return what the node uses, once several looks in a row show the same."""
    seen: list[dict[tuple[str, str], list[str]]] = []
    while len(seen) < ALIKE or seen.count(seen[-1]) < ALIKE:
        if process.poll() is not None:
            raise SystemExit('the node ended by itself')
        time.sleep(PAUSE)
        if NODE in observer.get_node_names():
            seen = [*seen, used(observer)][-ALIKE:]
    return seen[-1]


def main(path: Path) -> None:
    """Start the node, look at it, and write the policy."""
    import rclpy
    from rclpy.node import Node
    rclpy.init()
    observer = Node('observer')
    with subprocess.Popen([sys.executable, '-m', 'handeye_ros.node']) as process:
        try:
            path.write_text(policy(steady(observer, process)), encoding='utf-8')
        finally:
            process.terminate()
    rclpy.shutdown()


if __name__ == '__main__':
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else POLICY)
