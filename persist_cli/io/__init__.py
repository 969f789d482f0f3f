"""Files that are whole or absent, strict settings, the Hugging Face hub, and addresses of pages on this machine."""
