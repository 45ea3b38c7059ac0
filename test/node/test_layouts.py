# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The layouts for RViz and Foxglove show what the node publishes, under its names and types."""
from __future__ import annotations

from collections.abc import Iterator
import json
import re
from typing import Any

from command import ROOT
import pytest
import yaml

pytest.importorskip('rclpy', reason='needs rclpy')
import contract  # noqa: E402, I100
from ros_helpers import Client, running_node  # noqa: E402

pytestmark = pytest.mark.ros

RVIZ = ROOT / 'rviz' / 'handeye.rviz'
FOXGLOVE = ROOT / 'foxglove' / 'handeye.json'
TYPES = {'MarkerArray': 'visualization_msgs/msg/MarkerArray',
         'PointCloud2': 'sensor_msgs/msg/PointCloud2', 'Pose': 'geometry_msgs/msg/PoseStamped'}
DURABILITY = {'Transient Local': 1, 'Volatile': 2}


def displays() -> list[dict[str, Any]]:
    return yaml.safe_load(RVIZ.read_text())['Visualization Manager']['Displays']


def panels() -> dict[str, dict[str, Any]]:
    return json.loads(FOXGLOVE.read_text())['configById']


def placed(tree: Any) -> Iterator[str]:
    """Yield the panels of a layout's tree."""
    if isinstance(tree, str):
        yield tree
    else:
        assert tree.keys() == {'direction', 'first', 'second', 'splitPercentage'}
        assert tree['direction'] in ('row', 'column') and 0 < tree['splitPercentage'] < 100
        yield from placed(tree['first'])
        yield from placed(tree['second'])


def topics_of_foxglove() -> set[str]:
    found = set()
    for panel in panels().values():
        found |= set(panel.get('topics', ())) | {panel.get('topicToRender', '')}
        found.add(re.split(r'[.\[{]', panel.get('topicPath', ''))[0])
    return found - {''}


@pytest.fixture(scope='module')
def offered(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """Give what the node publishes, hears and serves: types and durability by name."""
    client = Client()
    try:
        with running_node(tmp_path_factory.mktemp('node')):
            client.until(lambda: client.node.get_node_names().count('handeye'), 'it is there')
            client.until(lambda: contract.listed() <= contract.offered(client),
                         'it offers all that the contract lists')
            topics = dict(client.node.get_topic_names_and_types())
            yield {'topics': topics, 'services': dict(client.node.get_service_names_and_types()),
                   'durable': {topic: info[0].qos_profile.durability.value for topic in topics
                               if (info := client.node.get_publishers_info_by_topic(topic))}}
    finally:
        client.close()


def test_rviz_shows_what_is_published(offered: dict[str, Any]) -> None:
    shown = [display for display in displays() if 'Topic' in display]
    assert len(shown) >= 5
    for display in shown:
        topic, kind = display['Topic'], display['Class'].removeprefix('rviz_default_plugins/')
        assert offered['topics'].get(topic['Value']) == [TYPES[kind]], topic['Value']
        durable = offered['durable'].get(topic['Value'])
        if durable:  # a display that wants more than is offered gets nothing
            assert DURABILITY[topic['Durability Policy']] >= durable


def test_rviz_finds_every_part(offered: dict[str, Any]) -> None:
    layout = yaml.safe_load(RVIZ.read_text())
    manager = layout['Visualization Manager']
    assert manager['Global Options']['Fixed Frame'] == 'base'
    assert all(display['Enabled'] and display['Name'] for display in displays())
    assert manager['Views']['Current']['Class'] == 'rviz_default_plugins/Orbit'


def test_foxglove_shows_what_is_published(offered: dict[str, Any]) -> None:
    assert topics_of_foxglove() <= offered['topics'].keys()
    services = {panel['serviceName'] for panel in panels().values() if 'serviceName' in panel}
    assert services and services <= offered['services'].keys()


def test_every_panel_of_foxglove_is_filled() -> None:
    layout = json.loads(FOXGLOVE.read_text())
    assert layout.keys() == {'configById', 'globalVariables', 'userNodes', 'playbackConfig',
                             'layout'}
    assert sorted(placed(layout['layout'])) == sorted(panels())
    assert all(panels().values())


@pytest.mark.parametrize(('name', 'panel'), [*panels().items()], ids=[*panels()])
def test_the_settings_are_those_of_foxglove(name: str, panel: dict[str, Any]) -> None:
    """Check every key against the classes in which Foxglove publishes its layouts."""
    layouts = pytest.importorskip('foxglove.layouts', reason='needs foxglove-sdk')
    kinds = {'3D': layouts.ThreeDeeConfig, 'RawMessages': layouts.RawMessagesConfig,
             'DiagnosticSummary': layouts.DiagnosticsSummaryConfig,
             'CallService': layouts.ServiceCallConfig}
    known = kinds[name.split('!')[0]].__dataclass_fields__
    given = {re.sub('([A-Z])', lambda found: '_' + found[1].lower(), key) for key in panel}
    assert given - {'foxglove_panel_title'} <= known.keys()


def test_another_namespace_is_one_replacement() -> None:
    text = re.sub('/handeye/', '/cell/handeye/', FOXGLOVE.read_text())
    assert json.loads(text)['configById'].keys() == panels().keys()
    assert '"/handeye/' not in text
