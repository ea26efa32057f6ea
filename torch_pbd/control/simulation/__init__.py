"""The simulated robot: plant, walls, force sensor, pushes, and runs of them."""
