"""Training scripts, one readable file each, and the planner that runs what they trained."""
