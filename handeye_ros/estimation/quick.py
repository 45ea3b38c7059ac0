"""A consensus from the first few guesses only, for questions that are asked many times."""
from __future__ import annotations

from itertools import islice

from handeye_ros.errors import HandeyeError
from handeye_ros.estimation.problem import Problem
from handeye_ros.estimation.robust import Consensus, without_outliers
from handeye_ros.estimation.trial import far, guesses, refined
import numpy as np

STARTS = 2
PROMISING = 16.0  # squared residual of most stations, in variances, that may become a good one


def quick_consensus(problem: Problem, seed: int = 0) -> Consensus | None:
    """Return what the samples agree on, None where the first few guesses promise nothing."""
    try:
        for start in islice(guesses(problem, np.random.default_rng(seed)), STARTS):
            if far(problem, start):
                continue
            trial = refined(problem, start)
            if trial.misfit < PROMISING:
                return without_outliers(trial)
    except (HandeyeError, np.linalg.LinAlgError):
        pass
    return None
