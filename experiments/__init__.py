"""Experiments: one file each, on one harness; ``ms-slam experiment list`` names them."""
