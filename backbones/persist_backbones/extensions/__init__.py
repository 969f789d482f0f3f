"""What is optional: LoRA, caches over denoising steps, offloading, memory savings."""
