"""Built-in scenarios: TOML files, listed by ``vcmvsp list``."""

if __name__ != "vcmvsp.scenarios":
    raise ImportError(f"this is vcmvsp.scenarios: import it by that name, not as '{__name__}'")
