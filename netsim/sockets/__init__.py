"""Programs that keep the run's own time: the run's side of `cosim.sockets`. No wall clock, and no channel."""
