"""Real robots as federates: this part holds no driver yet; see its README."""
