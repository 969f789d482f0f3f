"""The checks that ``persist inspect`` runs on a data set."""
