"""Camera images and pictures of worlds."""
