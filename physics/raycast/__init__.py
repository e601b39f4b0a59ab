"""Ray casting for range scanners: geometry alone, no noise and no sensor."""
