"""Multi-robot SLAM: relative poses of the robots' maps, and one merged map."""
