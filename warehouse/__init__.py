"""Where the assets rest and how they are asked: inbox, Parquet layout, ledger, execution, DuckDB catalog, reports."""
