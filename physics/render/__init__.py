"""Camera images and pictures of worlds: geometry and colours alone, no noise and no sensor."""
