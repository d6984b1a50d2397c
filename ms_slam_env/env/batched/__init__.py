"""The batched environment: many free cameras, each in a room of its own, stepped at once."""
