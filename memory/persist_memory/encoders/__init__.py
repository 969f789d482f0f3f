"""Encoders of images into feature maps."""
