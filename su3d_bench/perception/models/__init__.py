"""Foundation models: the catalogue, the location of their files, and how they are loaded and run."""
