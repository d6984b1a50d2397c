"""What several robots need: where their maps lie relative to each other, and one map of all."""
