"""The target models, one file each."""
from __future__ import annotations

from handeye_ros.config import Config
from handeye_ros.errors import BadValueError, OnlyFromFilesError
from handeye_ros.estimation.problem import Target
from handeye_ros.targets.line import LINE
from handeye_ros.targets.plane import PLANE
from handeye_ros.targets.plate import PLATE
from handeye_ros.targets.sphere import SPHERE
from handeye_ros.targets.wedge import WEDGE

METHODS: dict[str, Target] = {
    'plate': PLATE, 'line': LINE, 'plane': PLANE, 'sphere': SPHERE, 'wedge': WEDGE}
FROM_FILES = ('points', 'hand_eye', 'tracker')  # see files


def method_for(config: Config) -> Target:
    """
    Return the method that a configuration asks for.

    Raises BadValueError for a name that does not exist, OnlyFromFilesError for a target that is
    solved from files.
    """
    if config.target.type in FROM_FILES:
        raise OnlyFromFilesError(config.target.type)
    key, name = ('target.type', config.target.type) if config.method == 'auto' else (
        'method', config.method)
    if name not in METHODS:
        known = [*METHODS, *FROM_FILES] if key == 'target.type' else METHODS
        raise BadValueError(key, name, 'one of ' + ', '.join(known))
    return METHODS[name]
