"""From a frame that is sent to its reception reports: link budget, contention, losses, delays."""
