"""The pure core: numpy arrays in, numpy arrays and result objects out. No files, no tables, no configuration objects."""
