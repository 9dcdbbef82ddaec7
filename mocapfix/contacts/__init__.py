"""Contacts of the body with the floor: their detection, their use in the solve, and the events of gait."""
