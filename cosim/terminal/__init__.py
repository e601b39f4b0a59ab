"""What a terminal shows during a run or a study: progress, summary, table of vehicles.

Output alone: commands and options are `cosim.cli`.
"""
