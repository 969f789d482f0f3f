"""The interface of diffusers' pipelines for a backbone."""
