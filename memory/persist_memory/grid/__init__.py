"""Memories of cells: the 3D voxel map and the top-down map."""
