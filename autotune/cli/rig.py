"""Commands: first contact with a rig, and simulated rigs behind real transports."""
