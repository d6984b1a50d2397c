"""Planners that do not learn, one file each."""

from ms_slam_baselines.belief import Belief
from ms_slam_baselines.foresight import Foresight
from ms_slam_baselines.graph_dopt import GraphDOptimality
from ms_slam_baselines.greedy import GreedyDivergence
from ms_slam_baselines.greedy_limited import GreedyLimited
from ms_slam_baselines.held_nbv import HeldNextBestView
from ms_slam_baselines.max_information import MaxInformation
from ms_slam_baselines.nbv import NextBestView
from ms_slam_baselines.oracle import Oracle
from ms_slam_baselines.random_walk import RandomWalk
from ms_slam_baselines.receding_nbv import RecedingNextBestView
from ms_slam_baselines.stationary import Stationary

__all__ = [
    "Belief",
    "Foresight",
    "GraphDOptimality",
    "GreedyDivergence",
    "GreedyLimited",
    "HeldNextBestView",
    "MaxInformation",
    "NextBestView",
    "Oracle",
    "RandomWalk",
    "RecedingNextBestView",
    "Stationary",
]
