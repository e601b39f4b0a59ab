"""Plain UDP: a block of ports for each vehicle. Nothing of what the datagrams contain."""
