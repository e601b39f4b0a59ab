"""The same star of agents in each of the systems that are compared: programs that `bench.federation` runs."""
