"""Run a sequence through SLAM, and judge what came of it."""
