"""Download published weights and data from their stated sources, with checksums."""
