"""Leaders and followers in the air, and what they share. Nothing here is for wheels."""
