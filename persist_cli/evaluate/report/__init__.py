"""What people read of an evaluation: the report, tables for papers, and two runs side by side."""
