"""Sources, surroundings, materials on parts and a camera, as plain arrays."""
