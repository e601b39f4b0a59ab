"""The tables of a run in Arrow and Parquet: states and radio. Columns, units and labels: no metric and no figure."""
