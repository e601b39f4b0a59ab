"""Leaders and followers in the air."""
