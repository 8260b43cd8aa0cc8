"""Commands: the whole chain, from a config file to a verified controller."""
