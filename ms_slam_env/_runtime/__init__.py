"""Below all stages: files in and out, processes, interrupts, Warp, extension points."""
