"""Pictures of maps, scenes, the arm and an episode."""
