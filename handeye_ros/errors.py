# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The parents of all refusals, and those that several stages share.

A message says what is wrong, why it matters or how it was seen, and what to do. The exit
code is that of the command line: 2 for wrong usage or unreadable input, 3 for data that
cannot carry an answer.
"""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import difflib
import errno
import os
from pathlib import Path
import sys
import traceback
from typing import Any, TypeVar

T = TypeVar('T')
ERROR_MARK, WARNING_MARK = 'error: ', 'warning: '  # how lines on stderr begin
INSTALL_TF2 = ('install ros-jazzy-tf2-msgs and source the setup.bash of ROS or, where ROS comes '
               'from PyPI, run make tf2_msgs in the folder of this package')


class HandeyeError(Exception):
    """
    The parent of every error of this package that a user can act on.

    code: a short word where a program must tell refusals apart, '' elsewhere.
    """

    exit_code = 2

    def __init__(self, sentence: str = '', *, code: str = '') -> None:
        super().__init__(sentence)
        self.code = code

    def __reduce__(self) -> tuple[Any, ...]:
        """Support copy and pickle: the constructors of subclasses do not take the sentence."""
        return Exception.__new__, (type(self), str(self)), self.__dict__


class InputError(HandeyeError):
    """Wrong usage, or input that cannot be read (exit code 2)."""


def sentence_and_log(what: str, error: Exception) -> str:
    """Return the sentence of an exception; of one that is no refusal the log shows where."""
    if isinstance(error, HandeyeError):
        return str(error)
    print(*traceback.format_exception(error), file=sys.stderr, flush=True)
    return f'{what} failed: {error!r}; the log shows where'


def unusable_file(path: Path, reason: str) -> InputError:
    """Return the error for a file that cannot be used."""
    return InputError(f'{path} cannot be used: {reason}')


class UnusableMessageError(InputError):
    """A single message that cannot be used; the others may be."""


class DataError(HandeyeError):
    """Readable input that cannot carry an answer (exit code 3)."""

    exit_code = 3


class FeatureError(DataError):
    """A profile does not show what the method needs; the message says what is missing."""


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """Return a hint at a similar known word, or at a key that ends with the word; '' if none."""
    small = {other.lower(): other for other in known}
    close = [small[name] for name in difflib.get_close_matches(word.lower(), small, 1, 0.7)] or [
        other for other in known if other.endswith(f'.{word}')]
    return f'; did you mean "{close[0]}"?' if close else ''


def type_in_words(value: Any) -> str:
    """Return in words what a value is."""
    return (f'an array {value.shape} of {value.dtype}' if hasattr(value, 'dtype')
            else f'a {type(value).__name__}')


def require_type(name: str, value: object, *types: type) -> None:
    """Raise InputError, which names the argument, for a value of none of some types."""
    if not isinstance(value, types):
        raise InputError(f'{name}: {type_in_words(value)}, expected {types[0].__name__}')


def require_each(name: str, values: Iterable[T], *types: type) -> Iterator[T]:
    """Yield the values of an argument; raises InputError, which names it, for another type."""
    require_type(name, values, Iterable)
    for value in values:
        require_type(name, value, *types)
        yield value


def path_of(name: str, value: Path | str) -> Path:
    """Return an argument as a path; raises InputError, which names it."""
    require_type(name, value, str, os.PathLike)
    if '\0' in str(value):
        raise InputError(f'{name}: {value!r}, expected the name of a file')
    return Path(value)


class UnknownKeyError(InputError):
    """A configuration key that does not exist."""

    def __init__(self, key: str, known: Sequence[str], source: str) -> None:
        super().__init__(f'unknown key "{key}" in {source}{did_you_mean(key, known)}')


class BadValueError(InputError):
    """A configuration value of the wrong type or out of its range."""

    def __init__(self, key: str, value: object, expected: str) -> None:
        super().__init__(f'{key} is {value!r}, expected {expected}')


class UnwritableError(InputError):
    """A file or folder that cannot be written."""

    def __init__(self, path: object, error: OSError) -> None:
        reason = error.strerror or str(error)  # a sentence of this package holds its remedy
        remedy = {None: '', errno.ENOSPC: '; free some space', errno.EDQUOT: '; free some space',
                  errno.EEXIST: ', and is no folder; choose another place'}
        super().__init__(f'cannot write {path}: {reason}'
                         f'{remedy.get(error.errno, "; choose another place")}')


class TooFewError(DataError):
    """Too few data for a published algorithm."""


def require_count(method: str, minimum: int, what: str, count: int) -> None:
    """Raise TooFewError for less than a minimum."""
    if count < minimum:
        raise TooFewError(f'{method} needs at least {minimum} {what}, got {count}')


class SingularError(DataError):
    """Data for which a published algorithm is singular, or lacks an input."""

    def __init__(self, method: str, reason: str) -> None:
        super().__init__(f'{method} cannot be solved: {reason}')


class UnknownNameError(InputError):
    """
    A name that is not among the known ones.

    kind: what it should name; listing: the command that lists them, where they are many.
    """

    def __init__(self, kind: str, name: str, known: Sequence[str], listing: str = '') -> None:
        listed = f'"{listing}" lists them' if listing else f'the known ones: {", ".join(known)}'
        super().__init__(f'there is no {kind} "{name}"{did_you_mean(name, known)}; {listed}')


def looked_up(kind: str, name: str, mapping: Mapping[str, T]) -> T:
    """Return the value of a name; raises UnknownNameError. kind: what the name should name."""
    if name not in mapping:
        raise UnknownNameError(kind, name, list(mapping))
    return mapping[name]


class NoRosError(InputError):
    """Something that needs ROS, without ROS."""

    def __init__(self, verb: str, module: str) -> None:
        advice = INSTALL_TF2 if module == 'tf2_msgs' else (
            'source the setup.bash of ROS, or install handeye_ros[ros] with pip')
        super().__init__(f'{verb} needs ROS 2, and the Python module {module} is missing: '
                         f'{advice}')
