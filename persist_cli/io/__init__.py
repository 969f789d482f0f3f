"""Files that are whole or absent, strict settings, and the Hugging Face hub."""
