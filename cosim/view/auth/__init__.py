"""Access to the page: tokens, origins, allowed messages."""
