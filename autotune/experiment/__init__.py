"""The experiment on a rig: relay, safety envelope, plan, and the one loop that talks to hardware."""
