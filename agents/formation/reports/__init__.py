"""Reports between members: content, prediction, when sent, what was received. Nothing here commands a vehicle."""
