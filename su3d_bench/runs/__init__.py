"""``run``: from a request to jobs, scenes and frames, on this machine or on clusters; interrupted runs are resumed."""
