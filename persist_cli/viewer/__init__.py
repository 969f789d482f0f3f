"""``persist view``: memories, scenes, trajectories and rollouts in 3D, looked at and edited in a browser."""
