"""Several algorithms on one vehicle: which of them commands, and why. The algorithms themselves do not belong here."""
