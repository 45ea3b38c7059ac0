"""
The seam of simulated joints and curved preforms against the truth.

usage: .venv/bin/python bench/seam.py [SEEDS] [KIND...]

A preform of 200 mm with a lap of 5 mm (or a butt seam with a gap of 3 mm), points 0.4 mm apart
with 0.1 mm of noise on each axis: centre line against the true one (RMS and largest distance,
square to the seam), approach against the true normal, over SEEDS (default 20) seeds; the worst is
told. Then the joints of bench/joints.py, as a leaning sensor sees them, over as many seeds: the
largest errors where a seam was found, and how often it was refused. KIND: preform, or the first
word of a joint (butt, lap, vee, tee); all if none is given.
"""
from __future__ import annotations

import sys
import time

from handeye_ros.data import Array
from handeye_ros.errors import DataError
from handeye_ros.scanning.seam import find_seam, tool_frames
from handeye_ros.simulate.measuring import Preform, preform_cloud, PreformCloud
from joints import JOINTS, Scanned, scanned
import numpy as np
from scipy.spatial import cKDTree


def errors(truth: PreformCloud | Scanned, T_base_tool: Array) -> tuple[Array, Array]:
    """Return distances from the true line (m) and angles to the true approach (degrees)."""
    _, index = cKDTree(truth.centre).query(T_base_tool[:, :3, 3])
    tangent = np.gradient(truth.centre, axis=0)[index]
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    offset = T_base_tool[:, :3, 3] - truth.centre[index]
    offset -= (offset * tangent).sum(axis=1)[:, None] * tangent
    normal = truth.normals[index]
    normal = normal - (normal * tangent).sum(axis=1)[:, None] * tangent
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    cosine = -(normal * T_base_tool[:, :3, 1]).sum(axis=1)
    return np.linalg.norm(offset, axis=1), np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def preforms(seeds: int) -> None:
    """Print the errors of the curved preforms."""
    print(f'{"":6} centre line [mm]                     approach [degrees]     time [s]')
    print(f'{"":6} RMS: median worst  largest anywhere   median worst           median')
    for kind in ('lap', 'butt'):
        rms, largest, angle, seconds = [], [], [], []
        for seed in range(seeds):
            truth = preform_cloud(Preform(kind=kind), np.random.default_rng(seed))
            start = time.process_time()
            frames = tool_frames(find_seam(truth.points), 5e-3, -truth.normals.mean(axis=0))
            seconds.append(time.process_time() - start)
            away, turned = errors(truth, frames.T_base_tool)
            rms.append(1e3 * np.sqrt((away ** 2).mean()))
            largest.append(1e3 * away.max())
            angle.append(turned.max())
        print(f'{kind:6} {np.median(rms):11.3f} {max(rms):5.3f}  {max(largest):16.3f} '
              f'{np.median(angle):8.2f} {max(angle):5.2f} {np.median(seconds):16.1f}')


def joints(seeds: int, kinds: list[str]) -> None:
    """Print the errors of the joints whose first word is one of kinds."""
    print(f'\n{"":36} kind   largest off the line [mm], approach [degrees], missing at ends [mm]')
    for name in (name for name in JOINTS if name.split()[0] in kinds):
        joint = JOINTS[name]
        result = [of_joint(scanned(joint, np.random.default_rng(seed)), joint.length)
                  for seed in range(seeds)]
        found = [numbers for _, numbers in result if np.isfinite(numbers).all()]
        said = sorted({kind for kind, _ in result})
        print(f'{name:36} {", ".join(said):6} ' + '  '.join(
            f'{max(errors):.3f}' for errors in zip(*found, strict=True))
            + f'  {len(result) - len(found)} of {len(result)} refused'
            * (len(found) < len(result)), flush=True)


def of_joint(truth: Scanned, length: float) -> tuple[str, tuple[float, float, float]]:
    """Return the kind of the seam found, and its errors (mm, degrees, mm); NaN: refused."""
    try:
        seam = find_seam(truth.points)
    except DataError as refusal:
        return f'refused: {str(refusal)[:60]}', (np.nan, np.nan, np.nan)
    away, turned = errors(truth, tool_frames(seam, 5e-3).T_base_tool)
    return seam.kind, (1e3 * away.max(), turned.max(), length - 1e3 * seam.curve.length)


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    kinds = sys.argv[2:] or ['preform', 'butt', 'lap', 'vee', 'tee']
    if 'preform' in kinds:
        preforms(seeds)
    joints(seeds, kinds)


if __name__ == '__main__':
    main()
