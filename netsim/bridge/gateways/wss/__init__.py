"""USARSim Wireless Simulation Server."""
