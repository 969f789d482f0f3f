"""Maps of the ground from depth and memories, and ways over them."""
