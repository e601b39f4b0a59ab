"""Built-in scenarios: TOML files, listed by ``vcmvsp list``."""
