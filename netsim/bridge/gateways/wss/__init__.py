"""USARSim's Wireless Simulation Server: its control messages, and TCP relayed in frames. Levels come from the channel."""
