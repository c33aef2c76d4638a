"""What needs no light: distance, depth, normals, surface IDs, contours."""
