"""Files, settings, the hub and checkpoint folders."""
