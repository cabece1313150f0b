"""Per-image feature extraction: segmenters, encoders, the profiles that supply them, and their cache."""
