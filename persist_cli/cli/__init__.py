"""The command line ``persist``: its commands and their options."""
