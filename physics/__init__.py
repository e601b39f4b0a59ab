"""Virtual worlds: vehicles, what surrounds them, and their sensors. No radio, agent or real robot belongs here."""

if __name__ != "vcmvsp.physics":
    raise ImportError(f"this is vcmvsp.physics: import it by that name, not as '{__name__}'")
