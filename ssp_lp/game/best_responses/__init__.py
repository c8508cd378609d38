"""Best responses of the player to the adversary, per case of the paper (section 3.5)."""
