"""A backbone as a pipeline of diffusers' kind."""
