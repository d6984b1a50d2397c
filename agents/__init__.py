"""Training scripts, one readable file each; installed as `ms_slam_agents`."""
