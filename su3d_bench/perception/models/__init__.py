"""Foundation models: which there are, where their files lie, and how they are loaded and run."""
