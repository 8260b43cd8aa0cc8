"""Controllers and margins: from models or points to a controller with its guarantees."""
