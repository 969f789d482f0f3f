"""Memories of whole frames with their cameras, which never see depth."""
