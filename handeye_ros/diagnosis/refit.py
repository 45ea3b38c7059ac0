"""Samples fitted again under a changed assumption, as a solve would see them."""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros import targets
from handeye_ros.checks.alternatives import Fit, of_problem
from handeye_ros.config import Config
from handeye_ros.data import Sample
from handeye_ros.estimation.linearise import Problem
from handeye_ros.results.outcome import mounted
from handeye_ros.sampling.edge_shapes import consistent_edges


def fit_of(samples: Sequence[Sample], config: Config) -> Fit | None:
    """Return what samples agree on, None where they are too few or fit nothing."""
    method = targets.method_for(config)
    ordered, _ = consistent_edges(samples)
    if len(ordered) < method.minimum:
        return None
    observations = method.features.observe(ordered)
    return of_problem(Problem(method, mounted(ordered, config), observations, config))
