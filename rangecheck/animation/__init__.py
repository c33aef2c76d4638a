"""Orbits, and frames that are pure functions of their number."""
