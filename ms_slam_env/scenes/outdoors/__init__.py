"""What stands outdoors: streets, houses, facades, trees, cars, lamp posts; builders of patches."""
