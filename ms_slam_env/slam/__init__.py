"""SLAM backends."""
