"""The command line: signatures only; each command imports its work when it runs."""
