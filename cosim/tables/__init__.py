"""The tables of a run in Arrow and Parquet: states and radio."""
