"""
Every verification routine over seeds: are its regions honest, and does it see a wrong calibration.

usage: .venv/bin/python bench/verify.py [SEEDS] [ROUTINE...]

For each of SEEDS (default 200) a calibration is drawn with its stated covariance (0.03 mm and
0.01 degrees, 1 sigma of each axis) and measures a simulated artefact with the robot and sensor of
the main job. "within": how often the values lie within their stated 95 % region (for lines and
planes: the RMS distance below its stated 95 % bound). "wrong fails": how often a calibration that
is 1 mm and 0.5 degrees off fails at the default tolerance; the verdicts of the right one follow.
"""
from __future__ import annotations

from collections import Counter
import sys

from handeye_ros import se3
from handeye_ros.config import Config, NoiseConfig
from handeye_ros.data import Array, Calibration, Quality
from handeye_ros.measure.routine import Nominal, Routine, Seen
from handeye_ros.measure.routines import ROUTINES
from handeye_ros.measure.tooth_gauge import seen_in_pass
from handeye_ros.measure.track import Track
from handeye_ros.measure.verification import Verification
from handeye_ros.measure.verify import seen_in, verify
from handeye_ros.simulate import gauges
from handeye_ros.simulate.scenario import RobotModel, SensorModel
import numpy as np
from scipy.stats import chi2

STD = np.repeat([3e-5, np.deg2rad(0.01)], 3)
ROBOT = RobotModel()
NOISE = NoiseConfig(sensor=SensorModel().noise, robot_translation=ROBOT.repeatability[0],
                    robot_rotation=ROBOT.repeatability[1])
SCENES = {'line': gauges.line, 'plane': gauges.plane, 'point': gauges.fixed_point,
          'sphere': gauges.sphere, 'ball_bar': gauges.ball_bar, 'step': gauges.step_block,
          'square': gauges.square, 'tooth': gauges.tooth}
RADIUS = 0.02


def calibration(X: Array, covariance: Array) -> Calibration:
    return Calibration('bench', 'plate', 'flange', 'laser', X, covariance, {},
                       Quality(0, 0, 0.0, 0.0, '', 0.0), ())


def covariance(rng: np.random.Generator) -> Array:
    """Return a covariance with correlations, as calibrations have."""
    mixing = np.eye(6) + 0.3 * rng.normal(size=(6, 6))
    C = mixing @ mixing.T
    size = STD / np.sqrt(np.diag(C))
    return np.asarray(C * np.outer(size, size))


def scanned(made: gauges.Measured, config: Config) -> list[Seen]:
    """Return what a scan in passes gives the routine of the gauge."""
    return [seen_in_pass(part.profiles, Track(part.poses, 0.5), config) for part in made.passes]


def run(routine: Routine, found: Calibration, made: gauges.Measured) -> Verification:
    radius = RADIUS if routine.target == 'sphere' else 0.0
    aim = gauges.AIM if routine.name == 'point' else 0.0
    config = Config(noise=NOISE)
    bags = (scanned(made, config) if made.passes else
            [seen_in(routine, samples, found, config) for samples in made.bags])
    return verify(routine, bags, found, config,
                  Nominal(made.lengths, radius, made.reference, aim))


def within(found: Verification) -> bool:
    if not found.freedom:
        return found.scatter.rms <= found.scatter.expected
    return bool(found.region <= chi2.ppf(0.95, found.freedom))


def trial(name: str, seed: int) -> tuple[Verification, Verification]:
    """Return what a routine says of a right calibration, and of a wrong one."""
    rng = np.random.default_rng(seed)
    made, C = SCENES[name](rng), covariance(rng)
    X = se3.perturb(made.T_flange_sensor, np.linalg.cholesky(C) @ rng.normal(size=6))
    directions = rng.normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    off = np.concatenate([1e-3 * directions[0], np.deg2rad(0.5) * directions[1]])
    right, wrong = (run(ROUTINES[name], calibration(T, C), made)
                    for T in (X, se3.perturb(X, off)))
    return right, wrong


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    print(f'{"":9} within  wrong fails  noticed [mm]  verdicts of the right calibration')
    for name in sys.argv[2:] or SCENES:
        trials = [trial(name, seed) for seed in range(seeds)]
        inside = sum(within(right) for right, _ in trials)
        failed = sum(wrong.verdict == 'fail' for _, wrong in trials)
        noticed = np.median([right.noticed for right, _ in trials])
        verdicts = Counter(right.verdict for right, _ in trials)
        told = ', '.join(f'{count} {verdict}' for verdict, count in verdicts.most_common())
        print(f'{name:9} {inside / seeds:6.1%} {failed / seeds:11.1%} {1e3 * noticed:13.3f}  '
              f'{told}', flush=True)


if __name__ == '__main__':
    main()
