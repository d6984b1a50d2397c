"""Experiments: planners, their maps and trajectories, judged under one protocol."""
