"""Wrappers of the environments."""

from ms_slam_env.env.wrappers.perturbed import Perturbed

__all__ = ["Perturbed"]
