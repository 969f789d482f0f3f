"""CogVideoX as a world model, read from the top: backbone, diffusion, inputs, model, codec."""
