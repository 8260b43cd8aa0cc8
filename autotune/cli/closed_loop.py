"""Commands: identification of a plant under control."""
