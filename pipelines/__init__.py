"""When the assets are made and who watches: Dagster, the command line, rerun. The only place for these imports."""
