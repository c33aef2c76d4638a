"""The schema of every setting, and loading it."""
