"""Built-in simulators and the collection of trajectories in them."""
