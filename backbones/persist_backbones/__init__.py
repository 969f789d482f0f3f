"""Video diffusion models for persist (entry points: persist.backbones)."""
