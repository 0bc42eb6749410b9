"""What the assets are: declarations, configuration, algorithms, simulator. Knows no dagster, duckdb or rerun."""
