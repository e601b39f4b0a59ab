"""Path loss, walls, body shadowing, shadowing and fading."""
