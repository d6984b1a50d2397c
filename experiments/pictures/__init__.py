"""Pictures that no chart can show: maps, scenes, the arm, an episode."""
