"""Homes of several rooms: floor plan, walls with doors and windows, furniture, light."""
