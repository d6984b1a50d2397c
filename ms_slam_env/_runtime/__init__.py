"""Infrastructure below all other parts: files, processes, interrupts, Warp, extension points."""
