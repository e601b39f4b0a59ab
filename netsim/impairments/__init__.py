"""Loss, delay, rate limits, jammers, scripted changes and traces on top of reception."""
