"""Trajectories on disk: the store, clips of it, and the check of its conventions."""
