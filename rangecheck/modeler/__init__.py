"""Solids from primitives and booleans, every face numbered; line drawings."""
