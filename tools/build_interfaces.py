# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Build packages of ROS 2 messages into the virtual environment that runs this script.

usage: VENV/bin/python tools/build_interfaces.py PACKAGE_DIR...

A PACKAGE_DIR has the name of its package and holds msg/*.msg. The environment needs the wheels
ros-jazzy-rclpy[fastrtps] and ros-jazzy-common-interfaces, the machine gcc, g++ and Python's
headers. The type hashes are those that a ROS install gives the same messages.
"""
from __future__ import annotations

import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig
import tempfile

PREFIX = Path(sys.prefix)
os.environ.setdefault('AMENT_PREFIX_PATH', str(PREFIX))  # the generators look for templates

# The generators' classes are called directly: the `rosidl` command finds each
# of its entry points twice in these wheels and refuses.
import numpy  # noqa: E402
from rosidl_adapter.msg import convert_msg_to_idl  # noqa: E402
from rosidl_generator_c.cli import GenerateC  # noqa: E402
from rosidl_generator_py.cli import GeneratePython  # noqa: E402
from rosidl_generator_type_description.cli import HashTypeDescription  # noqa: E402
from rosidl_typesupport_c.cli import GenerateCTypesupport  # noqa: E402
from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport  # noqa: E402
from rosidl_typesupport_introspection_c.cli import (  # noqa: E402
    GenerateIntrospectionCTypesupport,
)

# rmw_fastrtps_cpp needs both, and finds them by dlopen('lib<package>__<name>.so')
IMPLEMENTATIONS = ['rosidl_typesupport_fastrtps_c', 'rosidl_typesupport_introspection_c']
PARTS = ['rosidl_generator_c', 'rosidl_generator_py', 'rosidl_typesupport_c', *IMPLEMENTATIONS]
WITH_HEADERS = [
    GenerateC('c'),
    GenerateFastRTPSCTypesupport('fastrtps_c'),
    GenerateIntrospectionCTypesupport('introspection_c'),
]
GENERATORS = [
    *WITH_HEADERS,
    GenerateCTypesupport('typesupport_c', typesupport_implementations=IMPLEMENTATIONS),
    GeneratePython('py', typesupport_implementations=['rosidl_typesupport_c']),
]


def missing_tools() -> list[str]:
    """Return what the machine lacks for a build."""
    headers = Path(sysconfig.get_path('include')) / 'Python.h'
    missing = [tool for tool in ('gcc', 'g++') if shutil.which(tool) is None]
    return missing if headers.exists() else [*missing, f"Python's headers ({headers})"]


def build(package: Path) -> None:
    """Build a package and install it, or raise CalledProcessError and install nothing."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        generate(package, work)
        link(package.name, work)
        install(package.name, work)


def generate(package: Path, work: Path) -> None:
    """Go from .msg by .idl and .json (type description and RIHS01 hash) to C, C++ and Python."""
    name, idls = package.name, []
    for file in sorted(package.glob('msg/*.msg')):
        idl = convert_msg_to_idl(
            package, name, file.relative_to(package), work / 'share' / 'msg')
        shutil.copy(file, idl.parent)
        idls.append(f'{work}/share:msg/{idl.name}')
    share = [PREFIX / 'share']
    hashes = HashTypeDescription('hash').generate_type_hashes(name, idls, share, work / 'share')
    for generator in GENERATORS:
        extra = {'type_description_files': hashes} if generator.name == 'c' else {}
        generator.generate(name, idls, share, work / generator.name / name, **extra)


def link(name: str, work: Path) -> None:
    """Compile everything into the one library work/lib<name>__<the first part>.so."""
    lib, include = PREFIX / 'lib', PREFIX / 'include'
    includes = [*(work / g.name for g in GENERATORS), include,
                *(folder for folder in include.iterdir() if (folder / folder.name).is_dir()),
                sysconfig.get_path('include'), numpy.get_include()]
    libraries = [so for part in PARTS for so in sorted(lib.glob(f'lib*__{part}.so'))
                 if so.name != library_name(name, part)]
    libraries += [*lib.glob('librosidl_*.so'),
                  *(lib / f'lib{so}.so' for so in ('rcutils', 'rmw', 'fastcdr'))]
    output = library_name(name, PARTS[0])
    # what the wheels' bootstrap set is for Python, not for the compiler
    environment = {key: v for key, v in os.environ.items() if key != 'LD_LIBRARY_PATH'}
    subprocess.run(
        ['gcc', '-O2', '-fPIC', '-shared', '-o', work / output, f'-Wl,-soname,{output}',
         *(f'-I{folder}' for folder in includes), *work.rglob('*.c'), *work.rglob('*.cpp'),
         '-Wl,--as-needed', f'-Wl,-rpath-link,{lib}', *libraries, '-lstdc++'],
        check=True, env=environment)


def library_name(package: str, part: str) -> str:
    return f'lib{package}__{part}.so'


def install(name: str, work: Path) -> None:
    """Put everything in its place; the Python package last, as the mark of a whole install."""
    lib, share = PREFIX / 'lib', PREFIX / 'share'
    headers = PREFIX / 'include' / name / name
    site = Path(sysconfig.get_path('platlib')) / name
    for old in site, headers, share / name:
        shutil.rmtree(old, ignore_errors=True)
    library = shutil.copy(work / library_name(name, PARTS[0]), lib)
    for part in PARTS[1:]:  # the one library goes by all the usual names
        replace_link(lib / library_name(name, part), library)
    for generator in WITH_HEADERS:  # for packages that build on this one
        shutil.copytree(work / generator.name / name, headers, dirs_exist_ok=True,
                        ignore=shutil.ignore_patterns('*.c', '*.cpp'))
    shutil.copytree(work / 'share', share / name)
    register(name, share)
    python = work / 'py' / name
    (python / '__init__.py').touch()
    replace_link(python / f'{name}_s__rosidl_typesupport_c.so', library)
    shutil.copytree(python, site, symlinks=True, ignore=shutil.ignore_patterns('*.c'))


def replace_link(link: Path, target: Path) -> None:
    link.unlink(missing_ok=True)
    link.symlink_to(target)


def register(name: str, share: Path) -> None:
    """Enter the package into the ament index."""
    index = share / 'ament_index' / 'resource_index'
    files = (file.relative_to(share / name) for file in (share / name).rglob('*.*'))
    (index / 'packages' / name).touch()
    (index / 'rosidl_interfaces' / name).write_text(
        '\n'.join(sorted(str(file) for file in files if file.suffix != '.json')))


def main() -> None:
    if missing := missing_tools():
        sys.exit(f'cannot build messages: this machine lacks {", ".join(missing)}')
    for folder in sys.argv[1:]:
        build(Path(folder).resolve())


if __name__ == '__main__':
    main()
