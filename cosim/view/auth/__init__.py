"""Access to the page: tokens, origins, allowed messages. Nothing of what the page shows."""
