"""``make bench``: what the platform costs beside what it is built on, both measured in the same run."""
