"""The simulated robot: plant, walls, force sensor, pushes, and what becomes of them."""
