"""Studies: a scenario run at every point of a grid, with the same seeds at each, and one table of what came out.

Start reading at `cosim.studies.engine`. ``grid`` says which values, ``plan`` which runs, ``examine`` what is wrong with them
before the first one; ``worker`` is one run, ``pool`` and ``cluster`` are where runs happen, ``rows`` and ``store`` keep what
they gave; ``summary`` and ``outputs`` draw it together.
"""
