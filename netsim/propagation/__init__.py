"""Models of the received level: path loss, walls, body shadowing, shadowing, fading. Nothing of standards or access."""
