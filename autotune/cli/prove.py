"""Commands: the proof of the diagnosis on recordings in which the effect is concealed."""
