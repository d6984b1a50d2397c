"""Things that stand in rooms.

Each function builds one thing in the builder's current frame: z up from what it stands on (or
from the point where it hangs), its back at y = 0, its front towards -y, x to the right of who
looks at its front, centred.
"""
