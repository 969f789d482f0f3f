"""A policy of NoMaD's architecture (Sridhar et al. 2023), trained on one's own data: *NoMaD-style*."""
