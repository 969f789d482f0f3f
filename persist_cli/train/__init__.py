"""Training of backbones and memory adapters in stages."""
