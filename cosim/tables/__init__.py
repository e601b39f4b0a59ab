"""The tables of a run in Arrow and Parquet: states and radio. Columns and units: no metric and no figure."""
