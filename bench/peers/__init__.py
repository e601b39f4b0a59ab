"""The same work in each of the compared systems: programs that `bench.asked` starts and queries."""
