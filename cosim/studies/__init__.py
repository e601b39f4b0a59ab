"""Studies: a scenario run at every point of a grid, with the same seeds at each, and one table of the results.

How one run is made is `cosim.runs`. Start reading at `engine`. `grid` holds the values, `plan` the runs, `checks` what is
refused before the first one; `worker` is one run, on this machine or on a `cluster`; `rows` and `store` keep the results,
`summary` and `outputs` present them.
"""
