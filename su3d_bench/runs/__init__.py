"""``run``: a request to jobs, jobs to scenes, frames to methods, here or on clusters; taken up where it was left."""
