"""The gate for CI: a run against a reference that earlier runs of the same request taught."""
