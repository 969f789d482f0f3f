"""Models that imagine scenes: they fill windows of cells."""
