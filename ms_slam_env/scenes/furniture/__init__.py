"""Furniture and other objects in rooms.

Each function builds one object in the builder's current frame: z up from the surface it stands on
(or the point where it hangs), back at y = 0, front towards -y, and x to the right seen from the
front, centred.
"""
