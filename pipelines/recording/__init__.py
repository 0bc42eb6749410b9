"""What a recording shows, subject by subject: `source` reads the warehouse, the others draw, `blueprint` arranges.

Nothing is estimated here; tables are shown, joined, moved by stored transforms, and thinned. These modules import rerun:
`pipelines.replay` imports them when a recording is written, not before.
"""
