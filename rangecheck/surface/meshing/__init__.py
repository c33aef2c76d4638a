"""From scans to a surface: one file per method, one signature."""
