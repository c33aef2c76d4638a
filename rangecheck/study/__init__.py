"""Speed against accuracy, and stability; takes callables, imports no stage."""
