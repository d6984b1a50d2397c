"""Builders of outdoor objects: streets, houses, facades, trees, cars, lamp posts."""
