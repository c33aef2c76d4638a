"""One self-contained HTML file; computes nothing."""
