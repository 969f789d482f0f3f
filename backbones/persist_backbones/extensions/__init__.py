"""Optional extensions of the backbone: LoRA, caches over denoising steps, offloading, memory savings."""
