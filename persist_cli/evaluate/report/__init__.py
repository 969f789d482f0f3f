"""The results of an evaluation for readers: the report, tables for papers, and two runs side by side."""
