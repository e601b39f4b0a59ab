"""From a frame that is sent to its reports: link budget, contention, losses, delays. No model of its own: models are layers."""
