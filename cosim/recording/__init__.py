"""What a run leaves: `run.mcap`, the rows of its tables, the log of external inputs; and reading it back.

No figures (`cosim.plots`), no other formats (`cosim.export`), no effect on the run. Start reading at `recorder`.
"""
