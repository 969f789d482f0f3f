"""Episodes of navigation in true scenes: how they are drawn and kept, and what an agent does in one of them."""
