# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
from glob import glob
import xml.etree.ElementTree as ElementTree

from setuptools import find_packages, setup

NAME = 'handeye_ros'
VERSION = ElementTree.parse('package.xml').findtext('version')  # the one place where it stands
FOLDERS = ('launch', 'config', 'rviz', 'foxglove')

setup(
    name=NAME,
    version=VERSION,
    description='Hand-eye calibration of laser line profilers, offline and as a ROS 2 node',
    license='Apache-2.0',
    maintainer='The handeye_ros developers',
    maintainer_email='maintainers@handeye-ros.example.org',
    python_requires='>=3.11',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', 'results/assets/*', 'page/assets/*', 'simulate/assets/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        *((f'share/{NAME}/{folder}', sorted(glob(f'{folder}/*.*'))) for folder in FOLDERS),
    ],
    zip_safe=False,
    install_requires=['aiohttp', 'numpy>=1.26', 'scipy>=1.11', 'PyYAML', 'jinja2',
                      'markupsafe', 'mcap', 'rosbags', 'rich', 'threadpoolctl',
                      'typer', 'zstandard'],
    extras_require={
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        'batch': ['distributed'],
        'kinematics': ['pin'],
        'test': ['hypothesis', 'opencv-python-headless<5', 'plyfile', 'pypcd4', 'pytest>=7.4',
                 'pytest-instafail', 'pytest-rerunfailures', 'pytest-timeout', 'pytest-xdist',
                 'selenium', 'urdf-parser-py'],
        'docs': ['mkdocs', 'pymdown-extensions'],
        'dev': ['colcon-common-extensions', 'flake8', 'foxglove-sdk', 'import-linter',
                'matplotlib', 'mkdocs', 'mypy', 'pymdown-extensions', 'ruff', 'types-PyYAML',
                'wheel'],
    },
    entry_points={
        'console_scripts': [
            'handeye = handeye_ros.cli:main',
            'calibrate = handeye_ros.node.calibrate:main',
            'corrected_pose = handeye_ros.node.corrected_pose:main',
            'publish = handeye_ros.node.publish:main',
            'replay = handeye_ros.node.replay:main',
            'scan = handeye_ros.node.scan:main',
        ],
    },
)
