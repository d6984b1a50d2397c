"""Motions and embodiments of the camera."""
