"""Effects put into recordings of rigs that exist: rig and noise are real, the effect is known exactly.

An effect of the reading is applied to the recorded y. An effect of the command is put in front of the rig: the recorded
u is what the effect turned out, so u is replaced by a command that the effect turns into the recorded one. As
:mod:`sim.conceal`, this package shares no code with the diagnosis.
"""
