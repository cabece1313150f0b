"""A registry of results: bundles of many people in one folder, held against each other, ranked, shown as a site."""
