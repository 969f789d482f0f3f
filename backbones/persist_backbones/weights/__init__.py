"""Where weights come from and how they are kept: presets, published models, checkpoints, LoRA, the prompt."""
