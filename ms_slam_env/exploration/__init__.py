"""Design-space exploration: parameters, studies on disk, workers and Pareto fronts.

Saeedi et al., ICRA 2017, section IV. What is evaluated is passed in as a callable.
"""

from ms_slam_env.exploration.explorer import explore
from ms_slam_env.exploration.objectives import METRICS, Constraint, parse_constraint
from ms_slam_env.exploration.parameters import Choice, Float, Integer, Parameter
from ms_slam_env.exploration.settings import Evaluate, ExplorationSettings
from ms_slam_env.exploration.space import SearchSpace, make_space

__all__ = [
    "METRICS",
    "Choice",
    "Constraint",
    "Evaluate",
    "ExplorationSettings",
    "Float",
    "Integer",
    "Parameter",
    "SearchSpace",
    "explore",
    "make_space",
    "parse_constraint",
]
