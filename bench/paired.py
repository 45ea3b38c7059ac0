# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Errors of several estimators on the same trials, side by side.

The first is ours. Of each other: its median error over ours, with the 95 % interval of that
ratio (bootstrap over the trials, both estimators always drawn together). An interval that holds
1 says that so many trials cannot tell which is better.
"""
from __future__ import annotations

from collections.abc import Container, Mapping

from handeye_ros import se3
import numpy as np

DRAWS = 4000
QUANTITIES = ('transl.', 'rotation', 'mapped')


def errors(T: np.ndarray, T_true: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (3,) translation (mm), rotation (degrees) and RMS of the mapped points (mm)."""
    delta = se3.difference(T, T_true)
    off = se3.apply(T, points) - se3.apply(T_true, points)
    return np.array([1e3 * np.linalg.norm(delta[:3]), np.degrees(np.linalg.norm(delta[3:])),
                     1e3 * np.sqrt((off ** 2).sum(axis=1).mean())])


def grid(*sides: tuple[float, ...]) -> np.ndarray:
    """Return the points (n, 3) that have one of the given coordinates along each axis."""
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 3)


def ratios(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return the median of theirs (n, k) over that of ours: value, low, high of each (3, k)."""
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, len(ours), (DRAWS, len(ours)))
    of_draws = [np.median(theirs[:, k][drawn], axis=1) / np.median(ours[:, k][drawn], axis=1)
                for k in range(ours.shape[1])]
    low, high = np.percentile(of_draws, [2.5, 97.5], axis=1)
    return np.array([np.median(theirs, axis=0) / np.median(ours, axis=0), low, high])


def print_table(title: str, found: Mapping[str, np.ndarray]) -> None:
    """Print medians and ratios of errors (n, 3) by estimator; rows of NaN are no answers."""
    print(title)
    print(f'{"":28} {"transl.":>8} {"rotation":>8} {"mapped":>8} {"worst":>8}   '
          + ' '.join(f'{f"{q} / ours":^18}' for q in QUANTITIES))
    print(f'{"":28} {"mm":>8} {"degrees":>8} {"mm":>8} {"mm":>8}')
    ours = None
    for name, values in found.items():
        answered = np.isfinite(values).all(axis=1)
        if not answered.any():
            print(f'{name:28} no answer')
            continue
        t, r, mapped = np.median(values[answered], axis=0)
        row = f'{name:28} {t:8.4f} {r:8.4f} {mapped:8.4f} {values[answered, 2].max():8.4f}'
        if ours is None:
            ours = values
        else:
            both = answered & np.isfinite(ours).all(axis=1)
            row += '   ' + ' '.join(f'{value:5.2f} ({low:4.2f}-{high:5.2f})' for value, low, high
                                    in ratios(ours[both], values[both]).T)
        missing = np.count_nonzero(~answered)
        print(row + (f'   {missing} without an answer' if missing else ''), flush=True)
    print()


def nearest(found: Mapping[str, np.ndarray], ours: Container[str]) -> list[str]:
    """
    Return for each quantity the least ratio of any published estimator, and whose it is.

    found: errors (n, 3) by estimator, the first ours; ours: further names that are not published.
    """
    first, *others = found.values()
    published = {}
    for name, values in zip(list(found)[1:], others, strict=True):
        both = np.isfinite(values + first).all(axis=1)
        if name not in ours and both.any():
            published[name] = ratios(first[both], values[both])
    if not published:
        return ['none published']
    texts = []
    for k in range(len(QUANTITIES)):
        name = min(published, key=lambda name: published[name][0, k])
        value, low, high = published[name][:, k]
        texts.append(f'{value:.2f} ({low:.2f}-{high:.2f}) {name.removeprefix("OpenCV, ")}')
    return texts


def print_nearest(title: str, found: Mapping[str, np.ndarray], ours: Container[str] = ()
                  ) -> None:
    """Print our medians and, for each quantity, what comes nearest, in a line."""
    t, r, mapped = np.nanmedian(next(iter(found.values())), axis=0)
    print(f'{title:53} {t:7.4f} {r:7.4f} {mapped:7.4f}  '
          + ' '.join(f'{text:43}' for text in nearest(found, ours)).rstrip(), flush=True)


def print_header() -> None:
    """Print the header of the lines of print_nearest."""
    print(f'{"":53} {"transl.":>7} {"rot.":>7} {"mapped":>7}  '
          + ' '.join(f'{f"nearest in {q}, / ours":43}' for q in QUANTITIES).rstrip())
    print(f'{"":53} {"mm":>7} {"degrees":>7} {"mm":>7}')
