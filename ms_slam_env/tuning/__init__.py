"""Design-space exploration: parameters, studies on disk, workers and Pareto fronts.

Saeedi et al., ICRA 2017, section IV. :func:`explore` takes the evaluation as a callable;
:func:`run_exploration` explores SLAM configurations over sequences and writes the results.
"""

from typing import TYPE_CHECKING

from ms_slam_env._runtime.lazy import lazy_names

if TYPE_CHECKING:
    from ms_slam_env.tuning.evaluator import SlamEvaluator
    from ms_slam_env.tuning.exploration import Exploration, run_exploration
    from ms_slam_env.tuning.explorer import explore
    from ms_slam_env.tuning.objectives import METRICS, Constraint, parse_constraint
    from ms_slam_env.tuning.parameters import Choice, Float, Integer, Parameter
    from ms_slam_env.tuning.settings import Evaluate, ExplorationSettings
    from ms_slam_env.tuning.space import SearchSpace, make_space
else:
    __getattr__ = lazy_names(__name__)

__all__ = [
    "METRICS",
    "Choice",
    "Constraint",
    "Evaluate",
    "Exploration",
    "ExplorationSettings",
    "Float",
    "Integer",
    "Parameter",
    "SearchSpace",
    "SlamEvaluator",
    "explore",
    "make_space",
    "parse_constraint",
    "run_exploration",
]
