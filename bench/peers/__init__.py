"""The same work in each of the systems that are compared: programs that `bench.asked` starts and asks."""
