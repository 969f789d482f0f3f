"""What ``persist inspect`` runs."""
