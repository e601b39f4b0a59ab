"""Physical layers: time on the air, noise and packet errors by SINR. Nothing of who sends when, which is `netsim.mac`."""
