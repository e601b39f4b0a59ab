"""Linux network namespaces, one for each vehicle."""
