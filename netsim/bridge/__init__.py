"""Programs as they are on the emulated network (README.md): the federate and the run's side. No sockets of programs here."""
