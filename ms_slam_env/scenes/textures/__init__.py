"""Procedural sRGB textures, one file per family; all tile unless they are pictures."""
