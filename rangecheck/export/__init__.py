"""Files for others: STL, 3MF, PLY, pictures, maps, video."""
